"""A sweep's results for other programs: a table of points as CSV, everything as JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

from server.events import LatencyFailed, PointFailed, SweepDone, failure_record
from server.points import LatencyResult, PointResult


def points_csv(results: Sequence[PointResult]) -> str:
    """One line a point, one column a figure; an undefined one is empty, its reason is in the JSON."""
    target = io.StringIO()
    rows = [_row(result) for result in results]
    writer = csv.DictWriter(target, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return target.getvalue()


def sweep_json(
    results: Sequence[PointResult],
    latencies: Sequence[LatencyResult],
    failures: Sequence[PointFailed | LatencyFailed],
    done: SweepDone,
    *,
    command: str,
) -> str:
    """Every point with its settings, figures and reasons, every latency, what could not be measured, and what the harness took."""
    record = {
        "command": command,
        "points": [{"key": result.point.key, **result.record()} for result in results],
        "latencies": [latency.record() for latency in latencies],
        "failures": [failure_record(failed) for failed in failures],
        "harness": {"work_s": done.work_s, "worker_s": done.worker_s, "overhead": done.overhead},
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def _row(result: PointResult) -> dict[str, Any]:
    point, quality = result.point, result.quality.record()
    del quality["undefined"]
    asked = ("clip", "width", "height", "fps", "low_height", "upscaler", "requested_kbps")
    return {
        **{name: getattr(point, name) for name in asked},
        "rendered_small": point.low_sha256 is not None,
        "bitrate_kbps": result.bitrate_kbps,
        "flags": " ".join(flag.name for flag in result.flags),
        **quality,
        "lpips": result.lpips,
        "key": point.key,
    }
