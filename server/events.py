"""What happens in a sweep, as it happens: a progress line, JSON lines and a service all read the same events."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from typing import Any

from server.points import LatencyResult, Point, PointResult


@dataclass(frozen=True)
class PlanMade:
    """The first event: how much there is to do, and how many workers do it."""

    points: int
    latencies: int
    workers: int


@dataclass(frozen=True)
class PointReused:
    """The point was in the store, from an earlier sweep or from another one at this moment."""

    result: PointResult


@dataclass(frozen=True)
class PointDone:
    """The point was measured and is in the store."""

    result: PointResult


@dataclass(frozen=True)
class PointFailed:
    """The point could not be measured: why, in one sentence, and where in the code. The sweep goes on."""

    point: Point
    reason: str
    trace: str


@dataclass(frozen=True)
class Waiting:
    """Another sweep on the same store is at work on what is left, or has to end before latency can be measured."""

    reason: str


@dataclass(frozen=True)
class LatencyReused:
    """The latency was in the store."""

    result: LatencyResult


@dataclass(frozen=True)
class LatencyDone:
    """The latency was measured while nothing else of the sweep ran, and is in the store."""

    result: LatencyResult


@dataclass(frozen=True)
class LatencyFailed:
    """The latency of one upscaler could not be measured. The sweep goes on."""

    clip: str
    low_height: int
    upscaler: str
    reason: str
    trace: str


@dataclass(frozen=True)
class SweepDone:
    """The last event. `work_s` are the seconds of all workers that went into encodes, decodes, inferences and metrics.

    `worker_s` are all seconds that the workers had, from the first job to the last result: what is not work is the
    harness. `overhead` is the harness over the work, None where nothing was computed.
    """

    done: int
    reused: int
    failed: int
    work_s: float
    worker_s: float

    @property
    def overhead(self) -> float | None:
        return self.worker_s / self.work_s - 1 if self.work_s else None


Event = PlanMade | PointReused | PointDone | PointFailed | Waiting | LatencyReused | LatencyDone | LatencyFailed | SweepDone


def failure_record(failed: PointFailed | LatencyFailed) -> dict[str, Any]:
    """What could not be measured, and why, ready for JSON; a latency has no bitrate that was asked for."""
    named = failed.point if isinstance(failed, PointFailed) else failed
    return {
        "clip": named.clip,
        "low_height": named.low_height,
        "upscaler": named.upscaler,
        "requested_kbps": failed.point.requested_kbps if isinstance(failed, PointFailed) else None,
        "reason": failed.reason,
    }


def event_record(event: Event) -> dict[str, Any]:
    """The event by name, ready for JSON: `event` is its kind, as point_done; results as the store holds them."""
    kind = re.sub(r"(?<!^)(?=[A-Z])", "_", type(event).__name__).lower()
    if isinstance(event, PointReused | PointDone | LatencyReused | LatencyDone):
        return {"event": kind, **event.result.record()}
    extra = {"overhead": event.overhead} if isinstance(event, SweepDone) else {}
    return {"event": kind, **asdict(event), **extra}
