"""gamesr-loss: the simulated network tells the truth about the pipeline, and the command about what it measured."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client.cloud import NetworkSettings, through_codec
from client.frames import Frame
from client.pipeline import upscale_stream
from client.sink import NullSink
from client.timing import LatencySummary, percentile
from client.upscaler import OnnxUpscaler
from client.video import Decoded
from client.vmaf import VmafScores
from server.crossing import DELAY_NS, Clip, Shuttle, watch
from server.link import Link, Weather
from server.lossy import DRAWN, LINKS, MODES, Row, main
from server.simulation import Simulation
from server.viewing import View, Viewing
from tests.moving import picture

PICTURES = [picture(t) for t in range(12)]
IDR = NetworkSettings(1500, 30, preset="ultrafast")
INTRA = NetworkSettings(1500, 30, preset="ultrafast", intra_refresh=True)
BOTH = pytest.mark.parametrize("settings", [IDR, INTRA], ids=["idr", "intra-refresh"])
BURSTS = Weather(loss=0.1, burst_packets=4, jitter_ns=5_000_000)

ModelFile = Callable[..., Path]


@pytest.fixture
def path(make_clip: Callable[..., Path]) -> Path:
    return make_clip(pictures=PICTURES, width=144, height=96)


@pytest.fixture
def clip(path: Path) -> Clip:
    return Clip(path, 48, 12)


def test_a_clip_runs_to_and_fro(clip: Clip, path: Path) -> None:
    assert [clip.at(index) for index in range(25)] == [*range(12), *range(10, -1, -1), 1, 2]
    assert Clip(path, 48, 1).at(5) == 0
    assert (clip.fps, clip.scale, clip.reduced[0].width) == (30, 2, 72)


@BOTH
def test_without_loss_it_is_the_pipeline_to_the_bit(clip: Clip, model_file: ModelFile, settings: NetworkSettings) -> None:
    upscaler = OnnxUpscaler(model_file(), threads=1)
    seen = watch(clip, settings, Weather(), 1, 30, {"tiny": upscaler})
    played = [clip.at(index) for index in range(30)]
    decoded = (Decoded(frame, 0, 0) for frame in through_codec([clip.reduced[at] for at in played], settings))
    direct = [done.picture.y for done in upscale_stream(decoded, upscaler, NullSink())]
    assert seen.errors["tiny"] == [
        float(np.mean((clip.references[at] - y.astype(float)) ** 2)) for at, y in zip(played, direct, strict=True)
    ]
    assert seen.views == [View.CLEAN] * 30 and (seen.lost, seen.keyframe_requests, seen.freezes, seen.recoveries) == (0, 0, [], [])


@BOTH
def test_the_figures_equal_a_computation_by_hand(clip: Clip, model_file: ModelFile, settings: NetworkSettings) -> None:
    """With a model that has no memory, so that nothing but the packets and what was shown when matters."""
    upscaler = OnnxUpscaler(model_file(stateful=False), threads=1)
    weather = Weather(0.1, 4, jitter_ns=5_000_000, delay_ns=DELAY_NS, begin_ns=1)
    simulation = Simulation(Shuttle(clip, settings), Link(weather, 7), Link(Weather(delay_ns=DELAY_NS), 7))
    frames: dict[int, Frame] = {arrival.index: arrival.received.frame for arrival in simulation.run(60)}
    squares, to_and_fro = [], [*range(12), *range(10, 0, -1)]
    for index in range(60):
        shown = frames[max(arrived for arrived in frames if arrived <= index)]
        enlarged, _ = upscaler.step(shown, upscaler.initial_state(48, 72))
        squares.append((clip.references[to_and_fro[index % 22]] - enlarged.y.astype(float)) ** 2)
    seen = watch(clip, settings, BURSTS, 7, 60, {"tiny": upscaler})
    row = Row.of("clip", "mode", "bursts", 7, seen)
    assert row.psnr_y_db["tiny"] == pytest.approx(10 * math.log10(255**2 / np.mean(squares)), abs=1e-9)
    worst = sorted(float(np.mean(square)) for square in squares)
    assert row.psnr_y_p5_db["tiny"] == pytest.approx(10 * math.log10(255**2 / worst[-3]), abs=1e-9)  # two of sixty are worse
    assert (row.sent, row.shown, row.damaged) == (60, len(frames), sum(frame.damaged for frame in frames.values()))
    assert row.packets_lost > 0 and row.shown < 60 and row.damaged > 0


@BOTH
def test_every_upscaler_has_the_same_packets_and_every_picture_one_view(
    clip: Clip, model_file: ModelFile, settings: NetworkSettings
) -> None:
    upscaler = OnnxUpscaler(model_file(), threads=1)
    seen = watch(clip, settings, BURSTS, 3, 60, {"one": upscaler, "two": upscaler})
    assert seen.errors["one"] == seen.errors["two"] and len(seen.errors["one"]) == len(seen.views) == 60
    assert sum(seen.count(view) for view in View) == 60
    assert sum(seen.freezes) == seen.count(View.FROZEN) and sum(seen.recoveries) == 60 - seen.count(View.CLEAN)


@BOTH
def test_more_loss_is_more_damage(clip: Clip, settings: NetworkSettings) -> None:
    def unclean(loss: float) -> int:
        return sum(60 - watch(clip, settings, Weather(loss=loss), seed, 60, {}).count(View.CLEAN) for seed in range(4))

    amounts = [unclean(loss) for loss in (0, 0.01, 0.05, 0.3)]
    assert amounts[0] == 0 and amounts == sorted(set(amounts))


def test_the_first_picture_arrives_whatever_the_network_does(clip: Clip) -> None:
    seen = watch(clip, IDR, Weather(loss=1), 1, 12, {})
    assert seen.views == [View.CLEAN] + [View.FROZEN] * 11 and seen.freezes == seen.recoveries == [11]


def test_runs_are_counted_by_what_was_on_the_screen() -> None:
    c, d, f = View.CLEAN, View.DAMAGED, View.FROZEN
    seen = Viewing(50, 100, 3, 1, [c, d, f, f, c, c, f, d], {"a": [1, 4, 0, 0, 1, 1, 1, 0], "b": [0] * 8})
    assert seen.freezes == [2, 1] and seen.recoveries == [3, 2]
    assert seen.psnr_y_db("a") == pytest.approx(48.1308, abs=1e-4) and seen.psnr_y_db("b") is None
    assert seen.psnr_y_p5_db("a") == pytest.approx(42.1102, abs=1e-4)  # of eight, none may be worse
    row = Row.of("clip", "mode", "link", 1, seen)
    assert (row.longest_freeze_ms, row.recovery_p50_ms, row.recovery_max_ms) == (40, 50, 60)
    assert row.cells() == ["mode", "link", "3.0%", "5 of 8", "25%", "2 (40 ms)", "50 / 60", "1", "48.13 / 42.11", "identical / identical"]


def test_a_percentile_is_one_of_the_values_wherever_it_is_taken() -> None:
    scores = [0.0, *[100.0] * 19]
    assert VmafScores.pool(np.array(scores[::-1])).p5 == 0
    assert Viewing(50, 1, 0, 0, [View.CLEAN] * 20, {"a": [1.0] * 19 + [255.0**2]}).psnr_y_p5_db("a") == 0
    assert (percentile(scores, 5), percentile(scores, 6), percentile(range(1, 101), 7), percentile([3.0], 1)) == (0, 100, 7, 3)
    assert LatencySummary.of([*range(100_000, 0, -1000)]).p95 == 95


def arguments(path: Path, model: Path, *more: str) -> list[str]:
    return [str(path), "--height", "48", "--bitrate", "1500k", "--frames", "24", "--models", f"bicubic,{model}", *more]


def test_the_command_says_the_same_every_time(path: Path, model_file: ModelFile, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = []
    for seed in ("4", "4", "5"):
        assert main(arguments(path, model_file(), "--json", "--seed", seed)) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1] != outputs[2]
    rows = [json.loads(line) for line in outputs[0].splitlines()]
    assert [(row["link"], row["mode"]) for row in rows] == [(link, mode) for link in LINKS for mode in MODES]
    assert all(set(row["psnr_y_db"]) == {"bicubic", "tiny"} for row in rows)
    assert rows[0]["packets_lost"] == rows[0]["damaged"] == 0 and rows[0]["recovery_p50_ms"] is None
    assert rows[list(LINKS).index("5%") * len(MODES)]["psnr_y_db"]["bicubic"] < rows[0]["psnr_y_db"]["bicubic"]


def test_the_table_and_the_picture(path: Path, model_file: ModelFile, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "loss.svg"
    assert main(arguments(path, model_file(), "--out", str(picture))) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert len(lines) == 2 + len(LINKS) * len(MODES) and len({line.count("|") for line in lines}) == 1
    assert lines[0].endswith("| bicubic, dB | tiny, dB |") and err.startswith("gamesr-loss: 12 rows in 0:")
    svg = picture.read_text()
    assert all(svg.count(f"<!-- {mode}, {link} -->") == 1 for mode in MODES for link in DRAWN) and svg.count("<!-- tiny -->") == 4
    assert main(arguments(path, model_file(), "--out", str(picture))) == 1
    assert capsys.readouterr().err == f"gamesr-loss: {picture} exists: name another file with --out, or replace it with --force\n"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"--height": "50"}, "{clip} is 144x96, which cannot be reduced to a height of 50 evenly"),
        ({"--height": "480"}, "{clip} is 144x96, which cannot be reduced to a height of 480 evenly"),
        ({"--height": "96"}, "no model named 'bicubic' ships for scale 1 (there is "),
        ({"--models": "bicubic,bicubic"}, "two of bicubic, bicubic have the same name: rename one"),
        ({"--models": ""}, "no model named '' ships for scale 2 (there is "),
        ({"--models": "{x3}"}, "x3 upscales by 3, but 48 lines are the clip's by 2"),
        ({"--out": "loss.png"}, "loss.png does not end in .svg, which is what --out draws"),
        ({"--out": "nowhere/loss.svg"}, "nowhere is no folder to write into"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_a_sentence(
    path: Path, model_file: ModelFile, capsys: pytest.CaptureFixture[str], change: dict[str, str], says: str
) -> None:
    names = {"clip": path, "x3": model_file("x3.onnx", scale=3)}
    given = {"--height": "48", "--models": "bicubic", "--frames": "4"} | {key: value.format(**names) for key, value in change.items()}
    assert main([str(path), *(part for pair in given.items() for part in pair)]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"gamesr-loss: {says.format(**names)}") and err.count("\n") == 1


def test_a_folder_that_cannot_be_written_is_said_before_any_row(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert main([str(path), "--out", str(tmp_path / "loss.svg")]) == 1
    assert capsys.readouterr() == ("", f"gamesr-loss: cannot write {tmp_path / 'loss.svg'}: {tmp_path} is not writable\n")


def test_what_is_no_clip_is_refused(tmp_path: Path, make_clip: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    parts = [make_clip(name, frames=2, width=width).read_bytes() for name, width in (("a.h264", 64), ("b.h264", 96))]
    (tmp_path / "both.h264").write_bytes(b"".join(parts))
    for name, says in (("text.mp4", "is not a video file"), ("missing.mp4", "does not exist"), ("both.h264", "changes its size")):
        assert main([str(tmp_path / name), "--height", "24"]) == 1
        err = capsys.readouterr().err
        assert says in err and err.count("\n") == 1


@pytest.mark.parametrize("options", [["--frames", "0"], ["--frames", "x"], ["--bitrate", "0"], ["--height", "-540"], ["--seed", "x"]])
def test_wrong_usage(path: Path, options: list[str]) -> None:
    with pytest.raises(SystemExit) as wrong:
        main([str(path), *options])
    assert wrong.value.code == 2
