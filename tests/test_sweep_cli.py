"""gamesr-sweep as a user meets it: what it prints and writes, and one sentence for everything that is wrong."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from server import cli
from server.events import Waiting
from server.points import PointResult
from server.progress import SweepProgress
from tests.sweeping import plan_of, sweep_here

SMALL = ("--bitrates", "0.2", "--heights", "36", "--jobs", "1")


@pytest.fixture
def clip(make_clip: Callable[..., Path]) -> Path:
    return make_clip("clip.mkv", width=96, height=72)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = cli.main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one sentence of a command that does nothing."""
    status, out, err = run(capsys, *arguments)
    assert (status, out) == (1, "") and err.count("\n") == 1 and err.startswith("gamesr-sweep: ") and "Traceback" not in err
    return err


def test_the_command_prints_writes_and_keeps(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (clip, *SMALL, "--upscalers", "none,bicubic", "--store", tmp_path / "store", "--out", tmp_path / "out")
    status, out, err = run(capsys, *arguments)
    assert (status, err) == (0, "") and "harness overhead" in out and "2 points measured, 0 reused, 0 failed" in out
    assert "no LPIPS" in out and "while nothing else of the sweep ran" in out
    with (tmp_path / "out/points.csv").open() as file:
        rows = list(csv.DictReader(file))
    record = json.loads((tmp_path / "out/sweep.json").read_text())
    points = [PointResult.from_record({k: v for k, v in point.items() if k != "key"}) for point in record["points"]]
    assert [row["upscaler"] for row in rows] == [result.point.upscaler for result in points] == ["none", "bicubic"]
    assert [float(row["vmaf"]) for row in rows] == [result.quality.vmaf for result in points] and rows[0]["lpips"] == ""
    assert [row["key"] for row in rows] == [result.point.key for result in points] and len(record["latencies"]) == 2
    assert record["harness"]["work_s"] > 0
    assert f"gamesr-sweep {clip} --bitrates 0.2" in (tmp_path / "out/report.md").read_text() and (tmp_path / "out/report.html").is_file()

    assert "is not empty" in refusal(capsys, *arguments)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "find_spec", lambda name: None)
        assert "pip install -c constraints.txt '.[sweep]'" in refusal(capsys, *arguments, "--force")
    status, out, _ = run(capsys, *arguments, "--force", "--json")
    events = [json.loads(line) for line in out.splitlines()]
    assert status == 0 and [event["event"] for event in events] == [
        "plan_made",
        *["point_reused"] * 2,
        *["latency_reused"] * 2,
        "sweep_done",
    ]
    assert json.loads((tmp_path / "out/sweep.json").read_text())["points"] == record["points"]


def test_bad_input_is_one_sentence_before_any_work(
    clip: Path, make_clip: Callable[..., Path], model_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, copy, store = tmp_path / "text.mkv", tmp_path / "copy.mkv", tmp_path / "store"
    text.write_text("no video")
    copy.write_bytes(clip.read_bytes())
    wide, small = (make_clip(f"{width}x36.mkv", width=width, height=36) for width in (64, 48))
    odd = make_clip("odd.mkv", width=97, height=72, pix_fmt="yuv444p")
    short = make_clip("short.mp4", width=48, height=36, frames=5)
    whole = make_clip("whole.mp4", width=96, height=72)
    bicubic = model_file("bicubic.onnx")
    cases: list[tuple[Sequence[object], str]] = [
        ((tmp_path / "none.mkv",), "does not exist"),
        ((text,), "is not a video file"),
        ((clip, copy), "are the same clip"),
        ((odd, "--heights", "72"), "not an even number of pixels"),
        ((clip, "--heights", "40"), "neither the whole, nor half, nor a third"),
        ((clip, "--upscalers", "none,sharpest"), "no model named 'sharpest'"),
        ((clip, "--upscalers", tmp_path / "none.onnx"), "cannot be read"),
        ((clip, "--upscalers", f"bicubic,{bicubic}"), "asked for twice"),
        ((clip, "--upscalers", f"none,{bicubic}", "--heights", "24"), "bicubic needs a height that is a half of a clip's"),
        ((clip, "--upscalers", "bicubic", "--heights", "72"), "bicubic needs a height that is a half or a third"),
        ((clip, "--fps", "20"), "no whole part"),
        ((clip, "--render", clip, wide), "which is neither half nor a third"),
        ((clip, "--render", small, small), "is not one of the clips"),
        ((whole, "--render", whole, short), "has 5 frames"),
        ((clip, "--lpips", text), "not a readable ONNX model"),
        ((clip, "--dask", "nowhere"), "no Dask scheduler"),
    ]
    for arguments, sentence in cases:
        assert sentence in refusal(capsys, *arguments, "--store", store), arguments
    assert not store.exists() or not sqlite3.connect(store).execute("SELECT 1 FROM points").fetchall()
    store.write_bytes(b"x" * 5000)
    assert "not a database" in refusal(capsys, clip, "--store", store)
    assert "Traceback" in run(capsys, clip, "--store", store, "--debug")[2]


def test_rates_that_differ_and_are_not_whole_are_refused(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for rate, sentence in (("25", "25 frames a second and"), ("12.5", "not a whole number")):
        other = tmp_path / f"{rate}.mkv"
        command = [imageio_ffmpeg(), "-v", "error", "-f", "lavfi", "-i", f"testsrc2=size=48x36:rate={rate}:duration=1", str(other)]
        subprocess.run(command, check=True)
        assert sentence in refusal(capsys, clip, "--render", clip, other, "--store", tmp_path / "store")


@pytest.mark.parametrize("name", ["vfr.mp4", "vfr.mkv"])
def test_a_varying_rate_is_refused(name: str, make_clip: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Bits a second would be those of another clip."""
    varying = make_clip(name, frames=9, pts=[0, 1, 2, 3, 10, 11, 12, 20, 30])
    said = refusal(capsys, varying, "--store", tmp_path / "store")
    assert "names 30 frames a second and has 8: its rate varies" in said and "ffmpeg -i INPUT -vf fps=30 OUTPUT" in said


def imageio_ffmpeg() -> str:
    import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_exe())


def test_what_fails_is_said_at_the_end_and_the_rest_stays(
    clip: Path, make_clip: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = make_clip("short.mkv", width=48, height=36, frames=5)
    arguments = (clip, *SMALL, "--upscalers", "none,bicubic", "--render", clip, short, "--store", tmp_path / "store")
    status, out, err = run(capsys, *arguments)
    assert status == 1 and "1 points measured, 0 reused, 1 failed" in out
    assert "2 points or latencies could not be measured" in err and "not as many frames" in err and err.count("\n") == 1


def test_a_report_that_lacks_what_failed_says_so_and_the_same_command_goes_on(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: object, target: object) -> None:
        raise OSError(28, "No space left on device")

    out = tmp_path / "out"
    arguments = (clip, *SMALL, "--upscalers", "none,bicubic", "--store", tmp_path / "store", "--out", out)
    with monkeypatch.context() as patch:
        patch.setattr("server.encoding.EncodedStream.write", full)
        assert run(capsys, *arguments)[0] == 1
    record = json.loads((out / "sweep.json").read_text())
    reason = "working files cannot be written: No space left on device"
    assert [(failed["upscaler"], failed["requested_kbps"], failed["reason"]) for failed in record["failures"]] == [
        ("none", None, reason),
        ("bicubic", None, reason),
    ]
    for page in ("report.md", "report.html"):
        said = (out / page).read_text()
        assert "0 points and 2 latencies could not be measured" in said and reason in said
    assert "is not empty" in refusal(capsys, *arguments, "--frames", "6")
    assert run(capsys, *arguments)[0] == 0 and json.loads((out / "sweep.json").read_text())["failures"] == []
    assert "could not be measured" not in (out / "report.md").read_text()
    assert "is not empty" in refusal(capsys, *arguments)
    (out / "report.html").unlink()  # as when it was killed in mid-report
    assert run(capsys, *arguments)[0] == 0 and (out / "report.html").exists()


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"command": 1, "failures": [1]}'])
def test_a_folder_of_somebody_else_is_not_written_into(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/sweep.json").write_text(content)
    assert "is not empty" in refusal(capsys, clip, *SMALL, "--store", tmp_path / "store", "--out", tmp_path / "out")


def test_names_that_are_no_text_are_written_as_far_as_they_are(
    clip: Path, model_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd, model = (clip.parent / os.fsdecode(name) for name in (b"caf\xe9.mkv", b"mod\xe8le.onnx"))
    clip.rename(odd)
    model_file("mine.onnx").rename(model)
    more = ("--frames", "3", "--store", tmp_path / "store", "--out", tmp_path / os.fsdecode(b"r\xe9sultat"))
    status, out, err = run(capsys, odd, *SMALL, "--upscalers", f"none,{model}", *more)
    assert (status, err) == (0, "") and "caf\\xe9" in out and "mod\\xe8le" in out
    assert "no latency: the first 5 frames are warm-up, and no more than 3 were asked for" in out
    page = (more[-1] / "report.html").read_text()  # type: ignore[operator]
    assert "caf\\xe9" in page and "mod\\xe8le" in page and "not measured: the first 5 frames are warm-up" in page


def test_names_stay_apart_where_two_clips_are_called_alike(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    for folder, frames in (("a", 12), ("b", 11)):
        (tmp_path / folder).mkdir()
        make_clip(f"{folder}/clip.mkv", width=96, height=72, frames=frames)
    names = {point.clip for point in plan_of(tmp_path / "a/clip.mkv", tmp_path / "b/clip.mkv").points}
    assert names == {str(tmp_path / "a/clip.mkv"), str(tmp_path / "b/clip.mkv")}


def test_by_default_every_height_that_fits_is_measured(make_clip: Callable[..., Path]) -> None:
    both, half = make_clip("both.mkv", width=96, height=72), make_clip("half.mkv", width=104, height=72)
    points = plan_of(both, half).points
    assert {(p.clip, p.low_height) for p in points} == {("both", 72), ("both", 36), ("both", 24), ("half", 72), ("half", 36)}


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_it_says_so_and_the_same_command_goes_on(clip: Path, tmp_path: Path, signum: int) -> None:
    command = [
        sys.executable,
        "-c",
        "from server.cli import main; raise SystemExit(main())",
        str(clip),
        "--store",
        str(tmp_path / "store"),
        "--json",
        "--jobs",
        "2",
    ]
    command += ["--upscalers", "none,bicubic,lanczos", "--heights", "36,24"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent) as process:
        assert process.stdout is not None and process.stderr is not None
        kinds = [json.loads(process.stdout.readline())["event"] for _ in range(2)]
        process.send_signal(signum)
        said = process.stderr.read()
    assert kinds == ["plan_made", "point_done"]
    assert (process.returncode, said) == (
        130,
        f"gamesr-sweep: interrupted: what was finished is in {tmp_path / 'store'}, and the same command goes on\n",
    )
    with sqlite3.connect(tmp_path / "store") as connection:
        assert connection.execute("SELECT count(*) FROM points").fetchone()[0] >= 1
        assert connection.execute("SELECT count(*) FROM claims").fetchone() == (0,)


def test_a_terminal_is_shown_how_far_it_is(clip: Path, tmp_path: Path) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    screen, file = Terminal(), io.StringIO()
    events = sweep_here(plan_of(clip, heights=[36], bitrates=[200]), tmp_path / "store")
    for stream in (screen, file):
        with SweepProgress(stream) as progress:
            for event in (*events[:2], Waiting("another sweep"), *events[2:]):
                progress.show(event)
    lines = screen.getvalue().split("\r\x1b[K")
    assert lines[1] == "0/2 points" and lines[2].startswith("1/2 points, 0:00 left") and lines[3].endswith("left, waiting: another sweep")
    assert lines[4] == "2 points, 0/0 latencies" and lines[-1] == "" and file.getvalue() == ""
