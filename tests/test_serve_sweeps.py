"""Sweeps over HTTP: they run beside the service, are followed, cancelled, bounded, and go on after whatever happened to it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from server import runner
from server.events import LatencyFailed, PlanMade, PointFailed, PointReused, Waiting
from server.run import Tracker
from server.runner import RunnerProcess, runs
from server.settings import Settings
from tests.measured import sweep_results
from tests.serving import ROOT, Command, events, serving, settings, until
from tests.sweeping import plan_of, sweep_here

SMALL: dict[str, Any] = {"bitrates_kbps": [200, 400], "upscalers": ["none", "bicubic"], "low_heights": [36]}
LONG: dict[str, Any] = {"bitrates_kbps": [100 * n for n in range(1, 9)], "upscalers": ["none", "bicubic", "lanczos", "fsr1"]}


@pytest.fixture
def folder(make_clip: Callable[..., Path], tmp_path: Path) -> Path:
    """With a clip that may be named."""
    (tmp_path / "clips").mkdir()
    make_clip("clips/clip.mkv", width=96, height=72, frames=24)
    return tmp_path


def of(folder: Path, **more: Any) -> Settings:
    return settings(folder, clips=folder / "clips", **more)


def start(client: httpx.Client, **more: Any) -> str:
    answer = client.post("/api/v1/sweeps", json={"clips": ["clip.mkv"], **SMALL, **more})
    assert answer.status_code == 202, answer.text
    assert answer.json()["progress"]["state"] == "queued"
    return str(answer.json()["id"])


def state(client: httpx.Client, sweep: str) -> str:
    return str(client.get(f"/api/v1/sweeps/{sweep}").json()["progress"]["state"])


def begun_by(process: psutil.Process) -> list[psutil.Process]:
    """The processes that it began, without the one that Python keeps beside them."""
    return [child for child in process.children() if not any("resource_tracker" in word for word in child.cmdline())]


def test_a_sweep_runs_in_a_process_of_its_own_and_is_followed(folder: Path) -> None:
    with serving(of(folder)) as client, RunnerProcess(of(folder)):
        until(lambda: client.get("/health").json()["runner"])
        sweep = start(client)
        seen = list(events(client, sweep))
        assert [e["state"] for e in seen[-1:]] == ["done"] and {"queued", "running"} >= {e["state"] for e in seen[:-1]}
        assert seen[-1]["points_done"] == seen[-1]["points_total"] == 4 and seen[-1]["latencies_done"] == 2
        assert [e["points_done"] for e in seen] == sorted(e["points_done"] for e in seen)
        found = client.get(f"/api/v1/sweeps/{sweep}").json()
        assert (found["origin"], found["low_heights"], found["failures"]) == ("service", [72, 36], [])
        assert [(c["clip"], c["source"]) for c in found["clips"]] == [("clip.mkv", "clip.mkv")]
        points = client.get(f"/api/v1/sweeps/{sweep}/points").json()["points"]
        assert len(points) == 4 and {point["clip"] for point in points} == {"clip.mkv"}
        by_hand = sweep_here(plan_of(folder / "clips/clip.mkv", heights=[36]), folder / "other")
        assert {p["key"] for p in points} == {e.result.point.key for e in by_hand if hasattr(e, "result")}
        assert [s["id"] for s in client.get("/api/v1/sweeps").json()["sweeps"]] == [sweep]
    assert not runs(of(folder).data)


def test_its_processes_give_way_to_everything_else(folder: Path) -> None:
    own = psutil.Process()
    with serving(of(folder)) as client, RunnerProcess(of(folder)):
        sweep = start(client, **LONG)
        until(lambda: state(client, sweep) == "running" and client.get(f"/api/v1/sweeps/{sweep}/points").json()["points"])
        nicenesses = [process.nice() for process in own.children(recursive=True)]
        lowered = min(19, own.nice() + 10)
        assert nicenesses.count(lowered) >= 2 and set(nicenesses) <= {own.nice(), lowered}


def test_one_that_runs_and_one_that_waits_can_be_cancelled(folder: Path) -> None:
    with serving(of(folder)) as client, RunnerProcess(of(folder)):
        running, waiting = start(client, **LONG), start(client)
        until(lambda: client.get(f"/api/v1/sweeps/{running}/points").json()["points"])
        assert client.post(f"/api/v1/sweeps/{waiting}/cancel").status_code == 202
        assert state(client, waiting) == "cancelled"
        assert client.post(f"/api/v1/sweeps/{running}/cancel").status_code == 202
        until(lambda: state(client, running) == "cancelled")
        kept = client.get(f"/api/v1/sweeps/{running}/points").json()["points"]
        assert 1 <= len(kept) < 32
        assert client.post(f"/api/v1/sweeps/{running}/cancel").status_code == 409
        assert client.post("/api/v1/sweeps/0123456789abcdef/cancel").status_code == 404
        assert [e["state"] for e in events(client, running)] == ["cancelled"]


def test_the_queue_is_bounded(folder: Path) -> None:
    with serving(of(folder, queued_sweeps=2)) as client:
        first = start(client)
        start(client)
        answer = client.post("/api/v1/sweeps", json={"clips": ["clip.mkv"], **SMALL})
        assert answer.status_code == 429 and answer.headers["retry-after"] and "wait already" in answer.json()["detail"]
        client.post(f"/api/v1/sweeps/{first}/cancel")
        start(client)


def test_what_cannot_be_swept_is_refused_while_the_caller_listens(folder: Path, make_clip: Callable[..., Path]) -> None:
    (folder / "clips/text.mkv").write_text("no video")
    (folder / "clips/copy.mkv").write_bytes((folder / "clips/clip.mkv").read_bytes())
    make_clip("clips/half.mkv", width=104, height=72)
    (folder / "secret.mkv").write_bytes((folder / "clips/clip.mkv").read_bytes())
    (folder / "clips/link.mkv").symlink_to(folder / "secret.mkv")
    cases: list[tuple[dict[str, Any], int, str]] = [
        ({"clips": ["none.mkv"]}, 404, "there is no clip none.mkv"),
        ({"clips": ["link.mkv"]}, 404, "there is no clip"),
        ({"clips": ["../secret.mkv"]}, 422, "should match pattern"),
        ({"clips": ["/etc/passwd"]}, 422, "should match pattern"),
        ({"clips": ["text.mkv"]}, 422, "is not a video file"),
        ({"clips": ["clip.mkv"], "upscalers": ["sharpest"]}, 422, "there is no upscaler sharpest"),
        ({"clips": ["clip.mkv"], "upscalers": ["../../x.onnx"]}, 422, "should match pattern"),
        ({"clips": ["clip.mkv"], "low_heights": [40]}, 422, "cannot be encoded at 40 lines, only at 72, 36, 24"),
        ({"clips": ["half.mkv"], "scales": [3]}, 422, "half.mkv cannot be encoded at 24 lines, only at 72, 36"),
        ({"clips": ["clip.mkv"], "scales": [2], "low_heights": [36]}, 422, "send one of them"),
        ({"clips": ["clip.mkv"], "scales": [4]}, 422, "less than or equal to 3"),
        ({"clips": ["clip.mkv", "half.mkv", "copy.mkv"]}, 422, "clip.mkv and copy.mkv are the same clip: name it once"),
        ({"clips": ["clip.mkv"], "upscalers": ["none", "bicubic"], "low_heights": [72]}, 422, "a half or a third of a clip's"),
        ({"clips": ["clip.mkv"], "fps": 7}, 422, "no whole part"),
        ({"clips": ["clip.mkv"], "bitrates_kbps": []}, 422, "at least 1 item"),
        ({"clips": ["clip.mkv"], "bitrates_kbps": [100, 100]}, 422, "twice"),
        ({"clips": ["clip.mkv"], "speed": 1}, 422, "Extra inputs"),
    ]
    with serving(of(folder)) as client:
        for sent, status, sentence in cases:
            answer = client.post("/api/v1/sweeps", json=sent)
            assert answer.status_code == status and sentence in answer.json()["detail"], (sent, answer.text)
            assert str(folder) not in answer.text
        clips = client.get("/api/v1/clips").json()
        assert [clip["name"] for clip in clips["clips"]] == ["clip.mkv", "copy.mkv", "half.mkv"]
        assert sorted(clips["refused"]) == ["link.mkv", "text.mkv"]
        assert clips["clips"][0]["low_heights"] == [72, 36, 24] and client.get("/api/v1/sweeps").json() == {"sweeps": []}


def test_a_sweep_that_fails_says_why_without_the_services_paths(folder: Path) -> None:
    with serving(of(folder)) as client:
        gone = start(client)
        (folder / "clips/clip.mkv").rename(folder / "clips/other.mkv")
        late = start_of(client, "other.mkv")
        with RunnerProcess(of(folder)):
            until(lambda: state(client, late) == "done")
        assert "is not there any more" in client.get(f"/api/v1/sweeps/{gone}").json()["progress"]["reason"]
        unfit = start_of(client, "other.mkv")
        (folder / "clips/other.mkv").write_text("no video")
        with RunnerProcess(of(folder)):
            until(lambda: state(client, unfit) == "failed")
        reason = client.get(f"/api/v1/sweeps/{unfit}").json()["progress"]["reason"]
        assert reason.startswith("other.mkv is not a video file") and str(folder) not in reason


def test_too_few_frames_for_a_latency_are_no_failure_and_a_clip_of_so_few_is_named(folder: Path, make_clip: Callable[..., Path]) -> None:
    make_clip("clips/short.mkv", width=96, height=72, frames=4)
    with serving(of(folder)) as client:
        few, short = start(client, frames=4), start_of(client, "short.mkv")
        with RunnerProcess(of(folder)):
            until(lambda: state(client, short) == "done")
        first, second = (client.get(f"/api/v1/sweeps/{sweep}").json() for sweep in (few, short))
        assert (first["progress"]["latencies_total"], first["failures"]) == (0, []) and first["progress"]["points_done"] == 4
        assert {failure["reason"] for failure in second["failures"]} == {
            "short.mkv has 4 frames, of which 5 are warm-up: use a longer clip"
        }


def test_scales_are_of_each_clips_own_height(folder: Path, make_clip: Callable[..., Path]) -> None:
    """A third of the one is a half of the other."""
    make_clip("clips/small.mkv", width=64, height=48)
    with serving(of(folder)) as client:
        asked = {"clips": ["clip.mkv", "small.mkv"], **SMALL, "low_heights": None, "scales": [2], "frames": 3}
        answer = client.post("/api/v1/sweeps", json=asked)
        assert answer.status_code == 202, answer.text
        with RunnerProcess(of(folder)):
            until(lambda: state(client, answer.json()["id"]) == "done")
        points = client.get(f"/api/v1/sweeps/{answer.json()['id']}/points").json()["points"]
    heights = {(point["clip"], point["low_height"]) for point in points}
    assert heights == {("clip.mkv", 72), ("clip.mkv", 36), ("small.mkv", 48), ("small.mkv", 24)}


def test_a_sweep_of_other_names_is_a_sweep_of_its_own(folder: Path) -> None:
    with serving(of(folder)) as client:
        first = start(client, frames=3)
        with RunnerProcess(of(folder)):
            until(lambda: state(client, first) == "done")
            (folder / "clips/clip.mkv").rename(folder / "clips/third.mkv")
            second = start_of(client, "third.mkv", frames=3)
            until(lambda: state(client, second) == "done")
        assert [clip["clip"] for clip in client.get(f"/api/v1/sweeps/{second}").json()["clips"]] == ["third.mkv"]
        assert len(client.get(f"/api/v1/sweeps/{second}/points", params={"clip": "third.mkv"}).json()["points"]) == 4


def test_a_folders_videos_that_are_no_clips_are_refused_with_the_reason(folder: Path) -> None:
    content = (folder / "clips/clip.mkv").read_bytes()
    unfit = ("My match.mp4", "spiel_\u00f6.mkv", "<b>.mkv", os.fsdecode(b"caf\xe9.mkv"))
    for name in (*unfit, "MATCH.MPG", "upload-0.mp4", ".hidden.mkv", "a.txt"):
        (folder / "clips" / name).write_bytes(content)
    (folder / "clips/link.mkv").symlink_to(folder / "clips/clip.mkv")
    (folder / "clips/folder.mkv").mkdir()
    with serving(of(folder)) as client:
        answer = client.get("/api/v1/clips")
        assert answer.status_code == 200 and [clip["name"] for clip in answer.json()["clips"]] == ["clip.mkv"]
    refused = answer.json()["refused"]
    assert set(refused) == {"My match.mp4", "spiel_\u00f6.mkv", "MATCH.MPG", "upload-0.mp4", "<b>.mkv", "caf\\xe9.mkv", "link.mkv"}
    assert {refused[name] for name in ("My match.mp4", "spiel_\u00f6.mkv", "<b>.mkv", "caf\\xe9.mkv")} == {
        "its name is not of 1 to 96 of A-Z a-z 0-9 . _ -, a letter or digit first: rename it"
    }
    assert "does not end in one of .mp4" in refused["MATCH.MPG"] and "is a link" in refused["link.mkv"]
    assert "as those of uploads do" in refused["upload-0.mp4"]


def test_the_runner_says_what_it_runs_and_refuses_what_is_no_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(of(folder)) as client:
        sweep = start(client)
    (folder / "clips/clip.mkv").unlink()
    arguments = [f"--store={folder}/store.sqlite", f"--data={folder}/data"]
    command = [sys.executable, "-c", "from server.runner import main; raise SystemExit(main())", *arguments, f"--clips={folder}/clips"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stderr is not None
        said = [process.stderr.readline() for _ in range(2)]
        process.terminate()
    assert said == [
        f"INFO server.runner: sweep {sweep} begins: none, bicubic on clip.mkv\n",
        f"INFO server.runner: sweep {sweep} is failed: 0 points are there, 0 failed\n",
    ]
    assert runner.main([*arguments, f"--clips={folder}/nosuch"]) == 1
    assert capsys.readouterr().err.startswith(f"gamesr-runner: {folder}/nosuch is not a folder")


def start_of(client: httpx.Client, clip: str, **more: Any) -> str:
    return str(client.post("/api/v1/sweeps", json={"clips": [clip], **SMALL, **more}).json()["id"])


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
def test_a_sweep_goes_on_when_the_service_is_started_again(folder: Path, signum: int) -> None:
    arguments = ("--store", folder / "store.sqlite", "--data", folder / "data", "--clips", folder / "clips")
    with Command(*arguments) as command:
        sweep = start(command.client, **LONG)
        before = until(lambda: command.client.get(f"/api/v1/sweeps/{sweep}/points").json()["points"])
        children = psutil.Process(command.pid).children(recursive=True)
        command.end(signum)
        gone, left = psutil.wait_procs(children, timeout=30)
        assert len(gone) >= 3 and not left
    with Command(*arguments) as command:
        assert state(command.client, sweep) in ("queued", "running")
        last = list(events(command.client, sweep))[-1]
        after = command.client.get(f"/api/v1/sweeps/{sweep}/points").json()["points"]
    assert last["state"] == "done" and last["points_done"] == len(after) == 32
    assert {point["key"] for point in before} <= {point["key"] for point in after}


def test_a_runner_that_dies_is_begun_again_and_two_share_nothing(folder: Path) -> None:
    own = psutil.Process()
    with serving(of(folder)) as client, RunnerProcess(of(folder)):
        until(lambda: client.get("/health").json()["runner"])
        (runner,) = begun_by(own)
        with RunnerProcess(of(folder)):
            sweeps = [start(client, bitrates_kbps=[kbps]) for kbps in (200, 300)]
            until(lambda: state(client, sweeps[0]) == "running")
            assert state(client, sweeps[1]) == "queued"
            runner.kill()
            until(lambda: {state(client, sweep) for sweep in sweeps} == {"done"})


def test_a_crash_of_its_process_is_said(folder: Path) -> None:
    own = psutil.Process()
    with serving(of(folder)) as client, RunnerProcess(of(folder)):
        sweep = start(client, **LONG)
        until(lambda: state(client, sweep) == "running")
        (runner,) = begun_by(own)
        (process,) = until(lambda: begun_by(runner))
        process.kill()
        until(lambda: state(client, sweep) == "failed")
        assert "its process ended before it was done" in client.get(f"/api/v1/sweeps/{sweep}").json()["progress"]["reason"]


def test_failures_of_points_are_listed_and_waiting_is_said() -> None:
    path = Path("/a/clip.mkv")
    tracker = Tracker({"clip.mkv": path})
    result = sweep_results(("clip.mkv",), (540,))[0]
    for event in (
        PlanMade(3, 1, 1),
        PointReused(result),
        Waiting("another sweep"),
        PointFailed(result.point, f"{path} changed", "trace"),
        LatencyFailed("clip.mkv", 540, "bicubic", "no time", "trace"),
    ):
        tracker.take(event)
        if isinstance(event, Waiting):
            assert tracker.progress.waiting == "another sweep"
    progress = tracker.progress
    assert (progress.points_done, progress.points_failed, progress.latencies_failed, progress.waiting) == (1, 1, 1, None)
    assert [failure.reason for failure in tracker.failures] == ["clip.mkv changed", "no time"] and progress.remaining_s is not None


def test_too_many_streams_of_events_are_refused_and_each_ends_after_a_while(folder: Path) -> None:
    with serving(of(folder, events_at_once=1, events_s=1.0)) as client:
        sweep = start(client)
        path = f"/api/v1/sweeps/{sweep}/events"
        with client.stream("GET", path) as first:
            lines = first.iter_lines()
            assert next(lines) == "event: progress"
            refused = client.get(path)
            assert refused.status_code == 429 and refused.headers["retry-after"]
            assert "data: " in "".join(lines)
        assert [e["state"] for e in events(client, sweep)] == ["queued"]
