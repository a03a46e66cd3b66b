"""When each frame passed each stage, and the percentiles of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Stamps:
    """`time.perf_counter_ns()` at the end of each stage of one frame: a stage is the difference of two neighbours.

    `packet_ns` is when the decoder was given the packet that released the frame.
    """

    packet_ns: int
    decoded_ns: int
    upscaled_ns: int
    written_ns: int


@dataclass(frozen=True, slots=True)
class LatencySummary:
    """Percentiles in microseconds over `count` frames, each of them a time that a frame really took (nearest rank)."""

    count: int
    p50: float
    p95: float
    p99: float
    max: float

    @classmethod
    def of(cls, durations_ns: Sequence[int]) -> LatencySummary:
        """Summarise durations in nanoseconds; raises ValueError when there are none."""
        if not len(durations_ns):
            raise ValueError("no durations to summarise")
        us = np.asarray(durations_ns, np.float64) / 1000
        p50, p95, p99 = np.percentile(us, (50, 95, 99), method="inverted_cdf")
        return cls(len(us), float(p50), float(p95), float(p99), float(us.max()))

    def record(self) -> dict[str, float]:
        return asdict(self)


def deadline_misses(durations_ns: Sequence[int], fps: int) -> int:
    """How many durations are longer than one frame lasts at `fps` frames per second."""
    return sum(duration_ns * fps > 1_000_000_000 for duration_ns in durations_ns)


def stage_latencies(stamps: Sequence[Stamps]) -> dict[str, LatencySummary]:
    """Summaries of decode, upscale, write and total; raises ValueError when there are no stamps."""
    return {
        "decode": LatencySummary.of([s.decoded_ns - s.packet_ns for s in stamps]),
        "upscale": LatencySummary.of([s.upscaled_ns - s.decoded_ns for s in stamps]),
        "write": LatencySummary.of([s.written_ns - s.upscaled_ns for s in stamps]),
        "total": LatencySummary.of([s.written_ns - s.packet_ns for s in stamps]),
    }
