"""When each frame passed each stage, and the percentiles of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass


@dataclass(frozen=True, slots=True)
class Stamps:
    """`time.perf_counter_ns()` at the end of each stage of one frame: a stage is the difference of two neighbours.

    `packet_ns` is when the decoder was given the packet that released the frame.
    """

    packet_ns: int
    decoded_ns: int
    upscaled_ns: int
    written_ns: int


def percentile(ascending: Sequence[float], percent: int) -> float:
    """The least of the values that so many percent of them do not exceed: one of them, never one between two (nearest rank)."""
    rank = -(-percent * len(ascending) // 100)  # whole numbers: 0.07 * 100 frames come to more than 7
    return ascending[max(rank, 1) - 1]


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
        us = sorted(float(duration_ns) / 1000 for duration_ns in durations_ns)
        return cls(len(us), percentile(us, 50), percentile(us, 95), percentile(us, 99), us[-1])

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
