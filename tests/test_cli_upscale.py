"""gamesr-upscale as it is typed: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client import cli
from client.command import run_command
from client.frames import Frame
from client.models import find_model
from client.progress import Progress
from client.upscaler import OnnxUpscaler, State
from client.video import read_frames
from tests.conftest import FRAMES, HEIGHT, WIDTH

MakeClip = Callable[..., Path]


@pytest.fixture
def tiny(model_file: Callable[..., Path]) -> str:
    return str(model_file())


def test_writes_beside_the_input_and_says_so(make_clip: MakeClip, tiny: str, capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip()
    assert cli.main([str(clip), "--model", tiny]) == 0
    frames = list(read_frames(clip.with_name("clip_gamesr_x2.mp4")))
    assert len(frames) == FRAMES and frames[0].y.shape == (2 * HEIGHT, 2 * WIDTH)
    said = capsys.readouterr()
    assert said.err == ""  # no terminal, no progress
    assert len(said.out.splitlines()) < 24
    for part in ("64x48 -> 128x96", "12 frames", "tiny x2", "cpu", "decode", "upscale", "write", "total", "p99"):
        assert part in said.out


def test_matroska_stays_matroska(make_clip: MakeClip, tiny: str) -> None:
    clip = make_clip("clip.mkv")
    assert cli.main([str(clip), "--model", tiny]) == 0
    assert clip.with_name("clip_gamesr_x2.mkv").is_file()


def test_json_is_one_object(make_clip: MakeClip, tiny: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(make_clip()), "--model", tiny, "--json", "--threads", "1"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    record = json.loads(line)
    assert (record["frames"], record["decode_errors"], record["damaged_frames"], record["state_resets"]) == (FRAMES, 0, 0, 0)
    assert (record["model"]["name"], record["model"]["scale"], record["model"]["precision"]) == ("tiny", 2, "float32")
    assert len(record["model"]["sha256"]) == 64
    assert (record["provider"], record["threads"], record["notes"]) == ("cpu", 1, [])
    for stage in ("decode", "upscale", "write", "total"):
        latency = record["latency_us"][stage]
        assert latency["count"] == FRAMES and 0 < latency["p50"] <= latency["p95"] <= latency["p99"] <= latency["max"]
    assert record["latency_us"]["total"]["max"] >= record["latency_us"]["upscale"]["max"]
    assert record["fps"] > 0 and "quality" not in record


@pytest.fixture
def original(make_clip: MakeClip, tmp_path: Path) -> Path:
    """The high-resolution original of `make_clip()`: what bicubic makes of it, so that bicubic must come out far best."""
    upscaler = OnnxUpscaler(find_model("bicubic", 2))
    upscaled = [upscaler.step(frame, upscaler.initial_state(HEIGHT, WIDTH))[0] for frame in read_frames(make_clip())]
    path = make_clip("reference.mkv", width=2 * WIDTH, height=2 * HEIGHT, pictures=upscaled, options={"qp": "0"})
    assert all(np.array_equal(a.y, b.y) for a, b in zip(read_frames(path), upscaled, strict=True))
    return path


def test_reference_measures_ours_and_both_baselines(
    make_clip: MakeClip, tiny: str, original: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([str(make_clip()), "--model", tiny, "--reference", str(original), "--json"]) == 0
    quality = json.loads(capsys.readouterr().out)["quality"]
    assert set(quality) == {"ours", "bicubic", "lanczos"}
    assert all(quality[name]["frames"] == FRAMES for name in quality)
    assert quality["bicubic"]["psnr_y_db"] is None and quality["bicubic"]["undefined"]["psnr_y_db"] == "identical"
    assert quality["bicubic"]["ssim_y"] == pytest.approx(1)
    assert quality["lanczos"]["psnr_y_db"] > quality["ours"]["psnr_y_db"] > 10


def test_what_ours_is_held_against_runs_on_the_processor(
    make_clip: MakeClip, tiny: str, original: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever runs ours: another runtime may damage the yardstick itself. Nor is its time ours, or its provider."""
    step, ran = OnnxUpscaler.step, set()

    def watched(self: OnnxUpscaler, frame: Frame, state: State) -> tuple[Frame, State]:
        ran.add((self.spec.name, self.provider))
        if self.spec.name != "tiny":
            time.sleep(0.2)
        return step(self, frame, state)

    monkeypatch.setattr(OnnxUpscaler, "step", watched)
    compared = ["--reference", str(original), "--compare", str(tmp_path / "wipe.png")]
    assert cli.main([str(make_clip(frames=3)), "--model", tiny, "--provider", "openvino", "--threads", "1", "--json", *compared]) == 0
    record = json.loads(capsys.readouterr().out)
    assert ran == {("tiny", "openvino"), ("bicubic", "cpu"), ("lanczos", "cpu")}
    assert record["provider"] == "openvino" and record["latency_us"]["total"]["p50"] < 200_000


def test_summary_shows_quality_and_why_a_figure_is_missing(
    make_clip: MakeClip, tiny: str, original: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([str(make_clip()), "--model", tiny, "--reference", str(original)]) == 0
    said = capsys.readouterr().out
    assert "VMAF-NEG" in said and "lanczos" in said and "no PSNR-Y dB" in said and "identical" in said


@pytest.mark.parametrize(("frames", "note"), [(7, "ends after 7 frames: the last 5"), (20, "longer than the 12 frames")])
def test_a_reference_of_another_length_is_said(
    make_clip: MakeClip, tiny: str, capsys: pytest.CaptureFixture[str], frames: int, note: str
) -> None:
    reference = make_clip("reference.mp4", width=2 * WIDTH, height=2 * HEIGHT, frames=frames)
    assert cli.main([str(make_clip()), "--model", tiny, "--reference", str(reference), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["frames"] == FRAMES and record["quality"]["ours"]["frames"] == min(frames, FRAMES)
    assert any(note in said for said in record["notes"])


@pytest.mark.parametrize("name", ["wipe.png", "wipe.mp4"])
def test_compare_draws(make_clip: MakeClip, tiny: str, tmp_path: Path, name: str) -> None:
    assert cli.main([str(make_clip()), "--model", tiny, "--compare", str(tmp_path / name)]) == 0
    assert (tmp_path / name).stat().st_size > 500


def test_a_baseline_takes_the_networks_place(make_clip: MakeClip, capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip()
    assert cli.main([str(clip), "--model", "lanczos", "--scale", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["model"]["name"] == "lanczos"
    assert next(read_frames(clip.with_name("clip_gamesr_x3.mp4"))).y.shape == (3 * HEIGHT, 3 * WIDTH)


def test_skipping_is_said_and_changes_nothing_without_a_state(make_clip: MakeClip, capsys: pytest.CaptureFixture[str]) -> None:
    still = next(read_frames(make_clip()))
    clip = make_clip("still.mp4", pictures=[still] * FRAMES, options={"qp": "20", "g": "100"})
    output = clip.with_name("still_gamesr_x2.mp4")
    contents, records = [], []
    for options in ([], ["--skip-unchanged"]):
        assert cli.main([str(clip), "--model", "bicubic", "--json", "--force", *options]) == 0
        contents.append(output.read_bytes())
        records.append(json.loads(capsys.readouterr().out))
    assert contents[0] == contents[1]
    assert records[0]["skipped_share"] is None and 0.5 < records[1]["skipped_share"] < 1
    assert cli.main([str(clip), "--model", "bicubic", "--force", "--skip-unchanged"]) == 0
    assert "% of the tiles" in capsys.readouterr().out


def test_leaving_squares_to_bicubic_is_said_and_changes_nothing_of_bicubic(make_clip: MakeClip, capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip(width=320, height=192)
    output = clip.with_name("clip_gamesr_x2.mp4")
    contents, records = [], []
    for options in ([], ["--detail-share", "0.25"]):
        assert cli.main([str(clip), "--model", "bicubic", "--json", "--force", *options]) == 0
        contents.append(output.read_bytes())
        records.append(json.loads(capsys.readouterr().out))
    assert contents[0] == contents[1]
    assert records[0]["network_share"] is None and 0.2 < records[1]["network_share"] < 0.8
    assert cli.main([str(clip), "--model", "bicubic", "--force", "--detail-share", "0.25"]) == 0
    assert "bicubic elsewhere" in capsys.readouterr().out


@pytest.mark.parametrize("options", [["0"], ["1"], ["nan"], ["half"], ["0.5", "--skip-unchanged"]])
def test_a_share_that_is_none_is_wrong_usage(make_clip: MakeClip, options: list[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        cli.main([str(make_clip()), "--detail-share", *options])
    assert stopped.value.code == 2


def test_existing_output_needs_force(make_clip: MakeClip, tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip, output = make_clip(), tmp_path / "out.mp4"
    output.write_text("mine")
    assert cli.main([str(clip), "-o", str(output), "--model", tiny]) == 1
    assert output.read_text() == "mine" and "--force" in capsys.readouterr().err
    assert cli.main([str(clip), "-o", str(output), "--model", tiny, "--force"]) == 0
    assert len(list(read_frames(output))) == FRAMES


@pytest.mark.parametrize("alias", ["clip.mp4", "./clip.mp4", "link.mp4"])
def test_the_input_is_never_overwritten(
    make_clip: MakeClip, tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], alias: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = make_clip()
    content = clip.read_bytes()
    (tmp_path / "link.mp4").hardlink_to(clip)
    monkeypatch.chdir(tmp_path)
    for option in ("-o", "--compare"):
        assert cli.main([str(clip), option, alias, "--model", tiny, "--force"]) == 1
        assert "it is the input" in capsys.readouterr().err
    assert clip.read_bytes() == content


def test_no_file_is_written_twice_or_over_the_reference(
    make_clip: MakeClip, tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip, reference = make_clip(), make_clip("reference.mp4", width=2 * WIDTH, height=2 * HEIGHT)
    common = [str(clip), "--model", tiny, "--force", "--reference", str(reference)]
    assert cli.main([*common, "-o", str(reference)]) == 1
    assert "it is the reference" in capsys.readouterr().err
    assert cli.main([*common, "-o", str(tmp_path / "x.mp4"), "--compare", str(tmp_path / "x.mp4")]) == 1
    assert "it is the output" in capsys.readouterr().err


def test_debug_shows_the_trace_and_the_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(tmp_path / "none.mp4"), "--debug"]) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said and said.splitlines()[-1] == f"gamesr-upscale: {tmp_path / 'none.mp4'} does not exist"


@pytest.mark.parametrize("arguments", [[], ["a.mp4", "--scale", "4"], ["a.mp4", "--threads", "0"], ["a.mp4", "--threads", "x"], ["a", "b"]])
def test_wrong_usage_exits_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(arguments)
    assert exit_.value.code == 2 and "usage: gamesr-upscale" in capsys.readouterr().err


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(["--help"])
    said = capsys.readouterr().out
    assert exit_.value.code == 0 and "examples:" in said and "--reference" in said


def test_examples_in_the_help_parse() -> None:
    examples = [line.split() for line in cli.EXAMPLES.splitlines() if line.startswith("  gamesr-upscale ")]
    assert len(examples) == 3
    for example in examples:
        assert cli.parser().parse_args(example[1:]).input == Path(example[1])


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_in_the_middle_leaves_no_file(
    make_clip: MakeClip,
    tiny: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    signum: signal.Signals,
) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also where the tests run under nohup
    clip = make_clip()
    before = sorted(tmp_path.iterdir())
    step, pts = OnnxUpscaler.step, []

    def interrupted(self: OnnxUpscaler, frame: Frame, state: State) -> tuple[Frame, State]:
        pts.append(frame.pts)
        if len([p for p in pts if p is not None]) == 6:
            assert list(tmp_path.glob("*.part"))
            os.kill(os.getpid(), signum)
        return step(self, frame, state)

    monkeypatch.setattr(OnnxUpscaler, "step", interrupted)
    assert cli.main([str(clip), "--model", tiny]) == 130
    assert capsys.readouterr().err == "gamesr-upscale: interrupted, nothing was written\n"
    assert sorted(tmp_path.iterdir()) == before
    # No second one stops the removal.
    assert {signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)} == {signal.SIG_IGN}


def test_under_nohup_a_terminal_may_close() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert run_command("gamesr", lambda: os.kill(os.getpid(), signal.SIGHUP), debug=False) == 0


def test_a_reader_that_leaves_is_no_crash(make_clip: MakeClip, tiny: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-c", "import sys; from client.cli import main; sys.exit(main())", str(make_clip()), "--model", tiny]
    finished = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (finished.returncode, finished.stderr) == (1, b"")


class Terminal:
    def __init__(self) -> None:
        self.text = ""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> None:
        self.text += text

    def flush(self) -> None:
        pass


def test_progress_is_drawn_on_a_terminal_and_wiped() -> None:
    terminal = Terminal()
    with Progress(terminal, 20) as progress:
        progress.advance()
    assert "1/20 frames" in terminal.text and "left" in terminal.text and terminal.text.endswith("\r\x1b[K")
