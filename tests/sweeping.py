"""Sweeps for the tests: small plans, workers in this process, and sweeps in processes that can be killed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from client.timing import LatencySummary
from server.events import Event, PointDone, PointReused, SweepDone
from server.job import Job, Outcome, run_job
from server.plan import Plan, Request, make_plan
from server.points import DEADLINES_FPS, LatencyResult, PointResult
from server.store import Store
from server.sweep import run_sweep
from server.workers import LocalWorkers

LEASE_S = 3.0


class Here:
    """Jobs one after the other in the process of the test."""

    count = 1

    def run(self, jobs: Iterator[Job]) -> Iterator[Outcome]:
        for job in jobs:
            yield from run_job(job)


def plan_of(
    *clips: Path, upscalers: str = "none,bicubic", bitrates: Sequence[int] = (200, 400), latency: bool = False, **more: Any
) -> Plan:
    """A plan without its latencies, which take a fresh process each, unless the test is about them."""
    plan = make_plan(Request(list(clips), list(bitrates), upscalers.split(","), **more))
    return plan if latency else replace(plan, latency_jobs=())


def sweep_here(plan: Plan, store: Path) -> list[Event]:
    with Store(store) as opened:
        return list(run_sweep(plan, opened, Here()))


def results(events: Sequence[Event]) -> dict[str, PointResult]:
    """By key; every point once."""
    found = [event.result for event in events if isinstance(event, PointDone | PointReused)]
    by_key = {result.point.key: result for result in found}
    assert len(by_key) == len(found)
    return by_key


def done(events: Sequence[Event]) -> SweepDone:
    (last,) = [event for event in events if isinstance(event, SweepDone)]
    assert events[-1] is last
    return last


def sweep_and_tell(plan: Plan, store: Path, tell: Connection) -> None:
    """For a process of its own: a sweep with two workers that sends every event, and goes on when it is told to."""
    tell.recv()
    with Store(store, lease_s=LEASE_S) as opened:
        for event in run_sweep(plan, opened, LocalWorkers(2)):
            tell.send(event)
            tell.recv()


def some_latency() -> LatencyResult:
    summary = LatencySummary(3, 1.0, 2.0, 3.0, 3.0)
    return LatencyResult(
        clip="clip",
        clip_sha256="0",
        width=96,
        height=72,
        low_height=36,
        bitrate_kbps=200.0,
        upscaler="bicubic",
        upscaler_sha256="1",
        machine="a machine",
        threads=2,
        latency_us={"decode": summary, "upscale": summary, "write": summary, "total": summary},
        deadline_misses=dict.fromkeys(DEADLINES_FPS, 0),
    )
