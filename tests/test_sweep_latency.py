"""Latency in a sweep: when it is taken, of what, and that it is kept under nothing else."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from client.cores import machine_name, physical_cores
from server.events import LatencyDone, LatencyFailed, LatencyReused, PointDone, Waiting
from server.latency import latency_key
from server.points import DEADLINES_FPS, LatencyResult
from server.store import Store
from server.sweep import run_sweep
from tests.sweeping import Here, plan_of, sweep_here

SIZE = {"width": 96, "height": 72}


@pytest.fixture
def clip(make_clip: Callable[..., Path]) -> Path:
    return make_clip("clip.mkv", **SIZE)


def test_a_latency_taken_at_another_niceness_is_another_one(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And at none it has the key that it had before niceness was in it."""
    ask = plan_of(clip, upscalers="bicubic", heights=[36], bitrates=[200]).jobs[0].asks[0]
    keys = []
    for niceness in (0, 10):
        monkeypatch.setattr(os, "nice", lambda _, niceness=niceness: niceness)
        keys.append(latency_key(ask))
    content = [ask.point.key, machine_name(), physical_cores(), 100]
    assert keys[0] == hashlib.sha256(json.dumps(content).encode()).hexdigest() != keys[1]


@pytest.mark.parametrize("changed", ["clip", "render", "model"])
def test_a_file_that_changes_after_the_last_point_fails_its_latency(
    clip: Path, make_clip: Callable[..., Path], model_file: Callable[..., Path], tmp_path: Path, changed: str
) -> None:
    """And no latency of another file is kept under its name."""
    small = make_clip("small.mkv", width=48, height=36)
    plan = plan_of(clip, upscalers=str(model_file("mine.onnx")), heights=[36], bitrates=[400], renders=[(clip, small)], latency=True)
    failed, kept = [], []
    with Store(tmp_path / "store") as store:
        for event in run_sweep(plan, store, Here()):
            if isinstance(event, PointDone) and changed == "model":
                model_file("mine.onnx", gain=0.25)
            elif isinstance(event, PointDone):
                name = {"clip": "clip.mkv", "render": "small.mkv"}[changed]
                make_clip(name, frames=10, **(SIZE if changed == "clip" else {"width": 48, "height": 36}))
            failed += [event.reason] if isinstance(event, LatencyFailed) else []
            kept += [event] if isinstance(event, LatencyDone) else []
    path = {"clip": clip, "render": small, "model": tmp_path / "mine.onnx"}[changed]
    assert failed == [f"{path} is not the file that was planned with: it changed, or is another one on this machine"] and kept == []


def test_latency_is_measured_after_the_points_and_kept(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="none,bicubic", heights=[36], bitrates=[200, 400, 800], latency=True)
    first, second = (sweep_here(plan, tmp_path / "store") for _ in range(2))
    found = [event.result for event in first if isinstance(event, LatencyDone)]
    assert [type(event) for event in first[1:-1]] == [PointDone] * 6 + [LatencyDone] * 2
    assert [(latency.upscaler, latency.low_height, latency.frames) for latency in found] == [("none", 72, 7), ("bicubic", 36, 7)]
    for latency in found:
        assert set(latency.deadline_misses) == set(DEADLINES_FPS) and latency.machine == machine_name()
        assert LatencyResult.from_record(json.loads(json.dumps(latency.record()))) == latency
    assert set(found[0].latency_us) == {"decode", "total"} and set(found[1].latency_us) == {"decode", "upscale", "write", "total"}
    assert [event.result for event in second if isinstance(event, LatencyReused)] == found


def test_there_is_no_latency_of_frames_that_are_all_warm_up(clip: Path, make_clip: Callable[..., Path], tmp_path: Path) -> None:
    assert plan_of(clip, frames=5, latency=True).latency_jobs == () and plan_of(clip, frames=6, latency=True).latency_jobs
    short = make_clip("short.mkv", frames=4, **SIZE)
    events = sweep_here(plan_of(short, heights=[36], bitrates=[400], latency=True), tmp_path / "store")
    failed = {event.reason for event in events if isinstance(event, LatencyFailed)}
    assert failed == {f"{short} has 4 frames, of which 5 are warm-up: use a longer clip"}


def test_latency_waits_for_other_sweeps_to_end(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="bicubic", heights=[36], bitrates=[200], latency=True)
    with Store(tmp_path / "store") as ours, Store(tmp_path / "store") as other:
        assert other.claim(["something else"]) == ["something else"]
        seen = []
        for event in run_sweep(plan, ours, Here()):
            seen.append(type(event))
            if isinstance(event, Waiting):
                other.release("something else")
        assert seen.index(PointDone) < seen.index(Waiting) < seen.index(LatencyDone)
