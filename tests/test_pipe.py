"""gamesr-upscale between other programs: what goes in and comes out by pipes is what goes by files."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import pytest

from client import cli
from client.frames import Frame
from client.pipe import PipeSink
from client.pipeline import upscale_stream
from client.upscaler import OnnxUpscaler
from client.video import VideoSource, read_frames
from tests.conftest import FRAMES, HEIGHT, WIDTH
from tests.streaming import planes

MakeClip = Callable[..., Path]
Upscale = Callable[..., "subprocess.CompletedProcess[bytes]"]


@pytest.fixture
def upscale(model_file: Callable[..., Path]) -> Upscale:
    def run(content: bytes, *arguments: object) -> subprocess.CompletedProcess[bytes]:
        command = [sys.executable, "-c", "import sys; from client.cli import main; sys.exit(main())", *map(str, arguments)]
        return subprocess.run([*command, "--model", str(model_file())], input=content, capture_output=True, check=False)

    return run


def stepped(clip: Path, model: Path) -> list[list[bytes]]:
    upscaler, found = OnnxUpscaler(model), []
    state = upscaler.initial_state(HEIGHT, WIDTH)
    for frame in read_frames(clip):
        upscaled, state = upscaler.step(frame, state)
        found.append(planes(upscaled))
    return found


def pictures(frames: Sequence[Frame]) -> list[list[bytes]]:
    return [planes(frame) for frame in frames]


@pytest.mark.parametrize("suffix", ["mkv", "ts", "h264"])
def test_a_pipe_into_a_pipe(make_clip: MakeClip, model_file: Callable[..., Path], upscale: Upscale, tmp_path: Path, suffix: str) -> None:
    clip = make_clip(f"clip.{suffix}", sample_aspect_ratio=Fraction(4, 3))
    done = upscale(clip.read_bytes(), "-", "-o", "-", "--json")
    out = tmp_path / "out.y4m"
    out.write_bytes(done.stdout)
    want = stepped(clip, model_file())
    assert done.returncode == 0 and pictures(list(read_frames(out))) == want and len(want) == FRAMES
    assert json.loads(done.stderr)["frames"] == FRAMES
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.sample_aspect_ratio) == (30, Fraction(4, 3))
    again = upscale(done.stdout, "-", "-o", tmp_path / "twice.mkv", "--json")  # .y4m in
    assert again.returncode == 0 and json.loads(again.stdout)["notes"] == ["of a pipe the picture alone is written: no sound, no subtitles"]
    assert [(frame.width, frame.height) for frame in read_frames(tmp_path / "twice.mkv")] == [(4 * WIDTH, 4 * HEIGHT)] * FRAMES


@pytest.mark.parametrize(
    "content", [b"", b"no video " * 1000, b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", b"ffconcat version 1.0\nfile /etc/passwd\n"]
)
def test_what_is_no_video_is_one_sentence(content: bytes, upscale: Upscale, tmp_path: Path) -> None:
    done = upscale(content, "-", "-o", tmp_path / "out.mp4")
    assert (done.returncode, done.stdout) == (1, b"") and b"standard input holds no video" in done.stderr and done.stderr.count(b"\n") == 1
    assert not list(tmp_path.glob("*out*"))


def test_a_file_that_needs_a_second_look_and_an_output_without_a_name(make_clip: MakeClip, upscale: Upscale) -> None:
    indexed_at_its_end = Path(__file__).parent / "footage/oa_koth1_540p.mp4"
    done = upscale(indexed_at_its_end.read_bytes(), "-", "-o", "-")
    assert (done.returncode, done.stdout) == (1, b"") and b"an .mp4 has to be a file" in done.stderr
    done = upscale(make_clip("clip.mkv").read_bytes(), "-")
    assert done.returncode == 1 and b"give one with -o" in done.stderr


class Interrupted(io.BytesIO):
    """A pipe in which nothing more comes until a signal does; whoever reads on would wait for ever."""

    signalled = False

    def seekable(self) -> bool:
        return False

    def read(self, size: int | None = -1) -> bytes:
        assert not self.signalled
        content = super().read(size)
        if not content:
            self.signalled = True
            raise KeyboardInterrupt
        return content


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_signal_while_a_pipe_is_read_leaves_no_file(
    make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """Whether nothing has come yet or the pipe stalls in the middle of the film."""
    content = make_clip("clip.ts", frames=60, options={"crf": "0"}).read_bytes()
    pipe = Interrupted(content[: int(share * len(content))])
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=pipe))
    before = sorted([*tmp_path.iterdir(), model_file()])
    assert cli.main(["-", "-o", str(tmp_path / "out.mp4"), "--model", str(model_file())]) == 130
    assert pipe.signalled and sorted(tmp_path.iterdir()) == before


def test_a_file_that_is_called_as_the_pipe_is(
    make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_clip("clip.mkv").rename(tmp_path / "-")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=Interrupted()))
    assert cli.main(["./-", "-o", "out.mp4", "--model", str(model_file())]) == 0
    assert len(list(read_frames(tmp_path / "out.mp4"))) == FRAMES


SMPTE_170M = (1, 6, 6, 6)
UNTAGGED = (0, 2, 2, 2)


@pytest.mark.parametrize(
    ("clip", "said"),
    [
        ({"tags": UNTAGGED}, []),
        ({"tags": UNTAGGED, "pts": [*range(6), *range(7, 13)]}, ["come up to 0.03 s from their time"]),
        ({"tags": UNTAGGED, "rotation": 90}, ["shown turned or mirrored"]),
        ({"tags": UNTAGGED, "audio": "aac"}, ["the sound is left out"]),
        ({"tags": SMPTE_170M}, ["the colours are smpte170m: give the next encoder -colorspace smpte170m"]),
        ({"tags": UNTAGGED, "width": 16, "height": 540, "frames": 2}, ["guess BT.601 up to 576 lines and BT.709 above"]),
    ],
    ids=["nothing", "times", "turned", "sound", "matrix", "untagged"],
)
def test_what_y4m_cannot_hold_is_said(
    make_clip: MakeClip, model_file: Callable[..., Path], clip: dict[str, object], said: list[str]
) -> None:
    out = io.BytesIO()
    with VideoSource(make_clip(**clip)) as source:
        sink = PipeSink(out, source)
        for _ in upscale_stream(source, OnnxUpscaler(model_file()), sink):
            pass
    assert len(sink.notes) == len(said) and all(part in note for part, note in zip(said, sink.notes, strict=True))


def test_a_reader_that_leaves_ends_it_without_a_word(make_clip: MakeClip, model_file: Callable[..., Path]) -> None:
    command = [sys.executable, "-c", "import sys; from client.cli import main; sys.exit(main())", str(make_clip(frames=60)), "-o", "-"]
    with subprocess.Popen([*command, "--model", str(model_file())], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout and process.stderr
        assert process.stdout.read(10) == b"YUV4MPEG2 "
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == (b"", 1)
