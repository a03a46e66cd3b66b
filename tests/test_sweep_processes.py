"""Sweeps of several processes: a worker that dies, a sweep that is killed, two sweeps on one store."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import sqlite3
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from server.events import Event, PointDone, PointFailed, PointReused
from server.plan import Plan
from server.points import PointResult
from server.store import Store
from server.sweep import run_sweep
from server.workers import LocalWorkers
from tests.sweeping import LEASE_S, Here, plan_of, results, sweep_and_tell, sweep_here

SIZE = {"width": 96, "height": 72}


@pytest.fixture
def clip(make_clip: Callable[..., Path]) -> Path:
    return make_clip("clip.mkv", **SIZE)


def test_a_worker_that_dies_fails_what_it_was_at_and_the_rest_goes_on(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="none,bicubic,lanczos,gamesr", heights=[36], bitrates=[200, 400])
    events = []
    with Store(tmp_path / "store") as store:
        for event in run_sweep(plan, store, LocalWorkers(1)):
            if isinstance(event, PointDone) and not any(isinstance(e, PointDone) for e in events):
                (worker,) = multiprocessing.active_children()
                os.kill(worker.pid or 0, signal.SIGKILL)
            events.append(event)
    failed = [event for event in events if isinstance(event, PointFailed)]
    assert failed and all("ended before it was done" in event.reason for event in failed)
    assert len(results(events)) == 8 - len(failed) >= 6
    assert len(results(sweep_here(plan, tmp_path / "store"))) == 8


def start_sweep(plan: Plan, store: Path) -> tuple[BaseProcess, Connection]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=sweep_and_tell, args=(plan, store, theirs))
    process.start()
    theirs.close()
    return process, ours


def children(process: BaseProcess) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for orphans in /proc")
def test_killed_in_mid_sweep_and_started_again_it_ends_as_if_nothing_had_been(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="none,bicubic,lanczos,gamesr", bitrates=[200, 400])
    whole = results(sweep_here(plan, tmp_path / "whole"))
    survived: dict[str, PointResult] = {}
    for _ in range(3):
        process, events = start_sweep(plan, tmp_path / "store")
        new = 0
        while new < 2:
            events.send("go on")
            event = events.recv()
            if isinstance(event, PointDone):
                survived[event.result.point.key] = event.result
                new += 1
        workers = children(process)
        process.kill()
        process.join()
        assert workers
        deadline = time.monotonic() + 30
        while any(Path(f"/proc/{pid}").exists() for pid in workers) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]
    with sqlite3.connect(tmp_path / "store") as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    with Store(tmp_path / "store", lease_s=LEASE_S) as store:
        last = list(run_sweep(plan, store, Here()))
    assert survived and results(last) == whole
    reused = {event.result.point.key for event in last if isinstance(event, PointReused)}
    assert survived.keys() <= reused and all(whole[key] == result for key, result in survived.items())


def test_two_sweeps_on_one_store_share_the_work(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="none,bicubic,lanczos", bitrates=[200, 300, 400])
    started = [start_sweep(plan, tmp_path / "store") for _ in range(2)]
    seen: dict[Connection, list[Event]] = {connection: [] for _, connection in started}
    for connection in seen:
        connection.send("go on")
    running = set(seen)
    while running:
        for connection in multiprocessing.connection.wait(list(running)):
            assert isinstance(connection, Connection)
            try:
                seen[connection].append(connection.recv())
                connection.send("go on")
            except (EOFError, BrokenPipeError):
                running.remove(connection)
    for process, _ in started:
        process.join()
        assert process.exitcode == 0
    first, second = seen.values()
    computed = [{e.result.point.key for e in events if isinstance(e, PointDone)} for events in (first, second)]
    assert computed[0] and computed[1] and not computed[0] & computed[1]
    everything = {point.key for point in plan.points}
    assert computed[0] | computed[1] == everything == set(results(first)) == set(results(second))
