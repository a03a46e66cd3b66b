"""What a sweep measures: points of rate-distortion curves, and the latency of every upscaler."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

from client.quality import Quality
from client.timing import LatencySummary

NO_UPSCALER = "none"
DEADLINES_FPS = (30, 60, 120)


@dataclass(frozen=True)
class Point:
    """One point as it is asked for: a clip brought to `low_height`, encoded at `requested_kbps`, upscaled and measured.

    The result depends on nothing else. `clip` and `upscaler` are names for people; the contents behind them are known by
    their sha256. `width`, `height` are those of the clip, which is what is measured against; `low_height` is the height
    that is encoded. The upscaler `none` is the native curve: the clip itself encoded, `low_height` equal to `height`.
    `low_sha256` is of a clip that was rendered small, None where the clip is downscaled by area. `frames` is the most
    frames that count, None for all. `encoder` is `CloudSettings.record()`, `versions` whatever else decides a figure.
    """

    clip: str
    clip_sha256: str
    width: int
    height: int
    fps: int
    frames: int | None
    low_height: int
    low_sha256: str | None
    requested_kbps: int
    encoder: dict[str, Any] = field(hash=False)
    upscaler: str
    upscaler_sha256: str | None
    versions: dict[str, str] = field(hash=False)

    @property
    def key(self) -> str:
        """The sha256 of everything that the result depends on: all fields but the names."""
        content = {name: value for name, value in self.record().items() if name not in ("clip", "upscaler")}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    @property
    def scale(self) -> int:
        return self.height // self.low_height

    def record(self) -> dict[str, Any]:
        """Every field by name, ready for JSON."""
        return asdict(self)


class Flag(Enum):
    """What a reader has to know of a point's bitrate."""

    ABOVE = "the encoder could not go down to the bitrate that was asked for"
    BELOW = "the stream came out more than 10% below the bitrate that was asked for"


@dataclass(frozen=True)
class PointResult:
    """One measured point. `bitrate_kbps` is the true one, counted from packets; curves are drawn over it, never over the asked one.

    `lpips` is the mean over the frames it was taken of, 0 is best; None where it was not measured, and `lpips_undefined`
    says why.
    """

    point: Point
    bitrate_kbps: float
    flags: tuple[Flag, ...]
    quality: Quality
    lpips: float | None
    lpips_undefined: str | None

    def record(self) -> dict[str, Any]:
        """Everything by name, ready for JSON; flags by their names."""
        return {**asdict(self), "flags": [flag.name for flag in self.flags]}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> PointResult:
        """What `record` wrote; raises KeyError or TypeError for anything else."""
        flags = tuple(Flag[name] for name in record["flags"])
        parts = {"point": Point(**record["point"]), "quality": Quality(**record["quality"]), "flags": flags}
        return cls(**{**record, **parts})


@dataclass(frozen=True)
class LatencyResult:
    """How long the client took over each frame of one stream, taken when nothing else of the sweep ran.

    `latency_us` is by stage: decode, upscale, write (handed to a sink that forgets it), total; the upscaler `none` has decode
    and total. `deadline_misses` is, by frame rate, how many of the frames took longer in total than one frame lasts.
    Warm-up frames are in neither. `machine` is the processor's name.
    """

    clip: str
    clip_sha256: str
    width: int
    height: int
    low_height: int
    bitrate_kbps: float
    upscaler: str
    upscaler_sha256: str | None
    machine: str
    threads: int
    latency_us: dict[str, LatencySummary] = field(hash=False)
    deadline_misses: dict[int, int] = field(hash=False)

    @property
    def frames(self) -> int:
        return self.latency_us["total"].count

    def record(self) -> dict[str, Any]:
        """Every field by name, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> LatencyResult:
        """What `record` wrote, also after a journey through JSON; raises KeyError or TypeError for anything else."""
        parts = {
            "latency_us": {stage: LatencySummary(**summary) for stage, summary in record["latency_us"].items()},
            "deadline_misses": {int(fps): count for fps, count in record["deadline_misses"].items()},
        }
        return cls(**{**record, **parts})
