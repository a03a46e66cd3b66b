"""A sweep as it was asked for: which points and latencies belong together, and what its user calls their clips and upscalers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

from server.points import Point


@dataclass(frozen=True)
class AskedClip:
    """A clip of a sweep; `frames` is the most frames that count, None for all."""

    name: str
    sha256: str
    width: int
    height: int
    fps: int
    frames: int | None


@dataclass(frozen=True)
class AskedPoint:
    """The key of a point, and its names in this sweep: the store has it under those of the sweep that measured it."""

    key: str
    clip: str
    upscaler: str


@dataclass(frozen=True)
class AskedSweep:
    """Everything in the order of the plan; `latencies` are keys, as `server.latency.latency_key` makes them."""

    clips: tuple[AskedClip, ...]
    upscalers: tuple[str, ...]
    low_heights: tuple[int, ...]
    bitrates_kbps: tuple[int, ...]
    points: tuple[AskedPoint, ...]
    latencies: tuple[str, ...]

    @classmethod
    def of(cls, points: Sequence[Point], latencies: Sequence[str]) -> Self:
        return cls(
            clips=tuple(dict.fromkeys(AskedClip(p.clip, p.clip_sha256, p.width, p.height, p.fps, p.frames) for p in points)),
            upscalers=tuple(dict.fromkeys(point.upscaler for point in points)),
            low_heights=tuple(sorted({point.low_height for point in points}, reverse=True)),
            bitrates_kbps=tuple(sorted({point.requested_kbps for point in points})),
            points=tuple(AskedPoint(point.key, point.clip, point.upscaler) for point in points),
            latencies=tuple(latencies),
        )

    @property
    def key(self) -> str:
        """The sha256 of all keys and names: the same question under the same names is the same sweep, whoever asks it."""
        content = [sorted((point.key, point.clip, point.upscaler) for point in self.points), sorted(self.latencies)]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def record(self) -> dict[str, Any]:
        """Every field by name, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """What `record` wrote, also after a journey through JSON; raises KeyError or TypeError for anything else."""
        return cls(
            clips=tuple(AskedClip(**clip) for clip in record["clips"]),
            upscalers=tuple(record["upscalers"]),
            low_heights=tuple(record["low_heights"]),
            bitrates_kbps=tuple(record["bitrates_kbps"]),
            points=tuple(AskedPoint(**point) for point in record["points"]),
            latencies=tuple(record["latencies"]),
        )
