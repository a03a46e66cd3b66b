"""gamesr-bench: structure and errors; how fast anything is, is never asserted."""

from __future__ import annotations

import json
import zlib
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from client import bench, synthetic
from client.bench import main
from client.errors import GamesrError
from client.measurement import WARM_UP_FRAMES, Task, measure, measure_in_fresh_process
from client.models import find_model
from client.synthetic import synthetic_frames, write_synthetic_clip
from client.video import read_frames


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "made.h264"
    write_synthetic_clip(path, 64, 48, WARM_UP_FRAMES + 3)
    return path


def test_the_made_clip_is_the_same_every_time_and_moves(tmp_path: Path, clip: Path) -> None:
    again = tmp_path / "again.h264"
    write_synthetic_clip(again, 64, 48, WARM_UP_FRAMES + 3)
    assert again.read_bytes() == clip.read_bytes()
    frames = list(synthetic_frames(64, 48, 4))
    assert np.array_equal(frames[1].y[:32, :40], frames[0].y[1:33, 3:43]) and not np.array_equal(frames[1].y, frames[0].y)
    decoded = list(read_frames(clip))
    assert len(decoded) == WARM_UP_FRAMES + 3 and decoded[0].y.shape == (48, 64) and decoded[0].colour.matrix == 1


def test_a_long_made_clip_scrolls_over_a_wall_that_does_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gigabytes for ten thousand frames otherwise. What needs no more steps has the pictures that it always had."""
    assert zlib.crc32(b"".join(plane.tobytes() for f in synthetic_frames(64, 48, 35) for plane in (f.y, f.u, f.v))) == 3278776385
    walls: list[int] = []
    noise = synthetic._noise
    monkeypatch.setattr(synthetic, "_noise", lambda rng, high, wide, cell: walls.append(high * wide) or noise(rng, high, wide, cell))
    before, after = deque(synthetic_frames(64, 48, 1000), 2)
    assert max(walls) < 350 * 900
    assert np.array_equal(after.y[:32, :40], before.y[1:33, 3:43]) and not np.array_equal(after.y, before.y)


def test_a_run_counts_only_frames_after_the_warm_up(clip: Path) -> None:
    run = measure(Task(find_model("bicubic", 2), clip, frames=2, provider="cpu", threads=1))
    assert {stage: summary.count for stage, summary in run.latency_us.items()} == dict.fromkeys(("decode", "upscale", "write", "total"), 2)
    assert (run.width, run.height, run.threads, run.spec.name, run.spec.scale) == (64, 48, 1, "bicubic", 2)
    assert run.fps > 0 and run.first_frame_ms > 0


def test_memory_is_that_of_a_fresh_process(clip: Path) -> None:
    ballast = np.ones(2**25)  # 256 MiB that a child must not inherit
    task = Task(find_model("bicubic", 2), clip, frames=1, provider="cpu", threads=1)
    here, there = measure(task).peak_memory_mib, measure_in_fresh_process(task).peak_memory_mib
    assert ballast.sum() == 2**25
    assert (here is None) == (there is None)
    assert here is None or there is None or 10 < there < here - 200


def test_json_holds_every_model_beside_its_yardstick(capsys: pytest.CaptureFixture[str], clip: Path) -> None:
    model = str(find_model("lanczos", 2))
    assert main(["--clip", str(clip), "--model", model, "--frames", "3", "--rounds", "2", "--threads", "1", "--json"]) == 0
    captured = capsys.readouterr()
    record = json.loads(captured.out)
    assert captured.err == ""
    assert (record["provider"], record["threads"], record["rounds"], record["warm_up_frames"]) == ("cpu", 1, 2, WARM_UP_FRAMES)
    assert [(result["model"]["name"], result["model"]["scale"]) for result in record["results"]] == [("bicubic", 2), ("lanczos", 2)]
    for result in record["results"]:
        assert result["input"] == {"width": 64, "height": 48} and result["frames"] == 3
        assert set(result["latency_us"]) == {"decode", "upscale", "write", "total"}
        for latency in result["latency_us"].values():
            assert 0 < latency["p50"] <= latency["p95"] <= latency["p99"] <= latency["max"]
        assert len(result["upscale_p95_us_by_round"]) == 2
        assert result["fps"] > 0 and result["first_frame_ms"] > 0 and result["upscale_p95_vs_bicubic"] > 0
    assert record["results"][0]["upscale_p95_vs_bicubic"] == 1


def test_table_shows_every_size_scale_and_stage(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bench, "SIZES", ((64, 48), (96, 64)))
    monkeypatch.setattr(bench, "measure_in_fresh_process", measure)
    assert main(["--model", "bicubic", "--frames", "2", "--rounds", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("cpu, ") and "2 frames" in lines[1]
    for size in ("64x48 in", "96x64 in"):
        block = lines[next(i for i, line in enumerate(lines) if line.startswith(size)) :][:17]
        assert [line.split()[:2] for line in block[1::4]] == [[name, f"x{scale}"] for scale in (2, 3) for name in ("bicubic", "lanczos")]
        assert [len(line.split()) for line in block[1:5]] == [7, 5, 5, 9]


def test_what_a_card_says_of_the_models_size_is_shown_for_the_size_of_the_clip(
    tmp_path: Path, clip: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "measure_in_fresh_process", measure)
    model = onnx.load(find_model("lanczos", 2))
    card = next(entry for entry in model.metadata_props if entry.key == "card")
    card.value = json.dumps({"parameters": 137_860, "macs_540p": 17_934_566_400})
    onnx.save(model, tmp_path / "sized.onnx")
    command = ["--model", str(tmp_path / "sized.onnx"), "--clip", str(clip), "--frames", "1", "--rounds", "1"]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    sized, plain = lines[-4:-1], lines[-8:-5]
    assert sized[1].startswith("  137.9K parameters upscale") and sized[2].startswith("  0.1 GMAC          write")  # 64x48 of 960x540
    assert [line.split()[0] for line in plain[1:]] == ["upscale", "write"]
    assert main([*command, "--json"]) == 0
    models = [result["model"] for result in json.loads(capsys.readouterr().out)["results"]]
    assert [(m["parameters"], m["macs_540p"]) for m in models] == [(None, None), (None, None), (137_860, 17_934_566_400)]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--clip", "missing.mp4"], "missing.mp4"),
        (["--model", "nosuch"], "nosuch"),
        (["--model", "missing.onnx"], "missing.onnx"),
    ],
)
def test_what_cannot_be_measured_is_one_sentence(capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str) -> None:
    assert main([*arguments, "--rounds", "1", "--frames", "1"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("gamesr-bench: ") and sentence in error and error.count("\n") == 1


def test_a_clip_that_ends_in_the_warm_up_is_refused(capsys: pytest.CaptureFixture[str], make_clip: Callable[..., Path]) -> None:
    assert main(["--clip", str(make_clip(frames=4)), "--model", "bicubic", "--rounds", "1"]) == 1
    assert "has 4 frames" in capsys.readouterr().err


def test_a_run_that_dies_is_reported(clip: Path, capfd: pytest.CaptureFixture[str]) -> None:
    broken = Task(find_model("bicubic", 2), clip, frames="few", provider="cpu", threads=1)  # type: ignore[arg-type]
    with pytest.raises(GamesrError, match=r"bicubic_x2\.onnx ended with status 1"):
        measure_in_fresh_process(broken)
    assert "TypeError" in capfd.readouterr().err


@pytest.mark.parametrize("arguments", [["--frames", "0"], ["--rounds", "-1"], ["--threads", "x"], ["--provider", "tpu"]])
def test_wrong_usage_is_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2 and arguments[0] in capsys.readouterr().err
