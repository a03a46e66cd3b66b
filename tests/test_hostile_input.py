"""Whatever is given to gamesr-upscale: one clear sentence and exit 1 with nothing left behind, or all that can be saved."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from client import cli
from client.video import read_frames
from tests.conftest import FRAMES

MakeClip = Callable[..., Path]
Run = Callable[..., dict[str, object]]


@pytest.fixture
def refused(tmp_path: Path, model_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs the command, checks that it refuses properly, and returns its sentence."""
    model = str(model_file())

    def run(*arguments: object) -> str:
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        assert cli.main([*map(str, arguments), *([] if "--model" in arguments else ["--model", model])]) == 1
        assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
        said = capsys.readouterr()
        (sentence,) = said.err.splitlines()
        assert said.out == "" and sentence.startswith("gamesr-upscale: ") and "Traceback" not in sentence
        return sentence.removeprefix("gamesr-upscale: ")

    return run


@pytest.fixture
def saved(tmp_path: Path, model_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command on what can be read, checks that every frame counted is in the file, and returns the JSON."""
    model = str(model_file())

    def run(clip: Path) -> dict[str, object]:
        output = tmp_path / "saved.mp4"
        assert cli.main([str(clip), "-o", str(output), "--model", model, "--json"]) == 0
        record: dict[str, object] = json.loads(capsys.readouterr().out)
        assert len(list(read_frames(output))) == record["frames"]
        assert not list(tmp_path.glob("*.part"))
        return record

    return run


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


NOISE = np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8).tobytes()


@pytest.mark.parametrize("name", ["noise.mp4", "noise.h264", "noise.mkv", "noise"])
@pytest.mark.parametrize("content", [b"\0", NOISE, b"%PDF-1.7 not a video\n"], ids=["one-byte", "noise", "text"])
def test_not_a_video(refused: Callable[..., str], tmp_path: Path, name: str, content: bytes) -> None:
    sentence = refused(write(tmp_path / name, content))
    assert "not a video file that can be opened" in sentence or "holds no video frame" in sentence or "no frame of" in sentence


def test_not_a_file(refused: Callable[..., str], tmp_path: Path) -> None:
    assert refused(tmp_path / "none.mp4").endswith("none.mp4 does not exist")
    assert refused(tmp_path).endswith("is not a file")
    assert refused(tmp_path / f"{'x' * 300}.mp4").endswith("cannot be read: File name too long")
    assert refused(write(tmp_path / "empty.mp4", b"")).endswith("empty.mp4 is empty")
    os.mkfifo(tmp_path / "pipe.mp4")
    assert refused(tmp_path / "pipe.mp4").endswith("is not a file")


def test_audio_only(refused: Callable[..., str], tmp_path: Path) -> None:
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        sound = container.add_stream("aac", rate=48000)
        block = av.AudioFrame.from_ndarray(np.zeros((2, 4800), np.float32), format="fltp", layout="stereo")
        block.sample_rate = 48000
        container.mux(sound.encode(block))
        container.mux(sound.encode(None))
    assert refused(tmp_path / "sound.mp4").endswith("sound.mp4 has no video stream (audio only)")


def test_a_cover_picture_is_no_film(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    picture, song = make_clip("cover.mp4", codec="mjpeg", pix_fmt="yuvj420p", frames=1, options={}), tmp_path / "song.mp4"
    with av.open(str(picture)) as cover, av.open(str(song), "w") as out:
        target = out.add_stream_from_template(cover.streams.video[0])
        target.disposition = Disposition.attached_pic
        packet = next(cover.demux(video=0))
        packet.stream = target
        out.mux(packet)
    assert refused(song).endswith("song.mp4 has no video stream but a cover picture")


def test_zero_frames(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    """A whole header with not one packet behind it."""
    with av.open(str(make_clip())) as source, av.open(str(tmp_path / "zero.mp4"), "w") as container:
        container.add_stream_from_template(source.streams.video[0], opaque=True)
        container.start_encoding()
    assert "zero.mp4" in refused(tmp_path / "zero.mp4")


def faststart(clip: Path) -> bytes:
    """The clip with its moov in front of its mdat."""
    path = clip.with_name("fast.mp4")
    with av.open(str(clip)) as source, av.open(str(path), "w", container_options={"movflags": "+faststart"}) as container:
        target = container.add_stream_from_template(source.streams.video[0], opaque=True)
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = target
                container.mux(packet)
    return path.read_bytes()


def test_mp4_cut_before_its_index(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    content = make_clip().read_bytes()
    assert content.index(b"mdat") < content.index(b"moov")
    cut = write(tmp_path / "cut.mp4", content[: content.index(b"moov") - 4])
    assert "cut short" in refused(cut)


def test_mp4_cut_after_its_index(saved: Run, make_clip: MakeClip, tmp_path: Path) -> None:
    content = faststart(make_clip(options={"g": "4", "crf": "10"}))
    start = content.index(b"mdat")
    record = saved(write(tmp_path / "cut.mp4", content[: start + (len(content) - start) // 2]))
    assert 3 <= record["frames"] < FRAMES
    assert any(f"announces 12 frames, {record['frames']} could be decoded" in note for note in record["notes"])


def test_mkv_cut_short_is_said(saved: Run, make_clip: MakeClip, tmp_path: Path) -> None:
    whole = make_clip("clip.mkv")
    assert saved(whole)["notes"] == []
    (tmp_path / "saved.mp4").unlink()
    content = whole.read_bytes()
    record = saved(write(tmp_path / "cut.mkv", content[: len(content) // 2]))
    assert 0 < int(str(record["frames"])) < 0.9 * FRAMES
    assert "it may be cut short" in str(record["notes"])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("spans", "least_ends"), [([(1 / 3, 1.0)], 0), ([(0.25, 0.3), (0.6, 0.65)], 2)], ids=["to the end", "twice"])
def test_flipped_bits(
    saved: Run, make_clip: MakeClip, tmp_path: Path, spans: list[tuple[float, float]], least_ends: int, seed: int
) -> None:
    """Twelve bits in these spans of a stream that has a key frame in two; the state starts again where damage ends, and nowhere else."""
    content = bytearray(make_clip("clip.h264", options={"g": "2", "crf": "10"}).read_bytes())
    rng = np.random.default_rng(seed)
    for start, stop in spans:
        for position in rng.integers(int(start * len(content)), int(stop * len(content)), 12 // len(spans)):
            content[position] ^= 1 << int(rng.integers(8))
    flipped = write(tmp_path / "flipped.h264", bytes(content))
    record = saved(flipped)
    assert FRAMES // 3 <= record["frames"] <= FRAMES
    assert record["frames"] + record["decode_errors"] >= FRAMES - 1
    damaged = [frame.damaged for frame in read_frames(flipped)]
    ends = sum(before and not after for before, after in pairwise(damaged))
    assert ends >= least_ends  # the flips did what they are there for
    assert (record["damaged_frames"], record["state_resets"]) == (sum(damaged), ends)


def packets_of(clip: Path) -> list[bytes]:
    with av.open(str(clip)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def test_a_packet_of_garbage(saved: Run, make_clip: MakeClip, tmp_path: Path) -> None:
    clip = make_clip("clip.mkv")
    packet = packets_of(clip)[3]
    broken = write(tmp_path / "garbage.mkv", clip.read_bytes().replace(packet, NOISE[: len(packet)]))
    record = saved(broken)
    assert (record["frames"], record["decode_errors"]) == (FRAMES - 1, 1)
    assert (record["damaged_frames"], record["state_resets"]) == (2, 1)  # where damage ends


def test_what_is_measured_behind_a_frame_that_is_missing_is_said_to_be_shifted(
    make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a container that announces no number of frames, too."""
    clip, original = make_clip("clip.mkv"), make_clip("original.mkv", width=128, height=96)
    packet = packets_of(clip)[3]
    broken = write(tmp_path / "garbage.mkv", clip.read_bytes().replace(packet, NOISE[: len(packet)]))
    for path, shifted in ((clip, 0), (broken, 1)):
        options = ["-o", str(tmp_path / "saved.mp4"), "--reference", str(original), "--model", str(model_file()), "--json", "--force"]
        assert cli.main([str(path), *options]) == 0
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert sum("they meet the wrong frame of the reference" in note for note in notes) == shifted


def test_missing_packets(saved: Run, make_clip: MakeClip, tmp_path: Path) -> None:
    packets = packets_of(make_clip("clip.h264"))
    record = saved(write(tmp_path / "holes.h264", b"".join(packets[:2] + packets[4:])))
    assert record["frames"] == FRAMES - 2


def test_resolution_change(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    first, second = make_clip("a.h264").read_bytes(), make_clip("b.h264", width=96, height=80).read_bytes()
    sentence = refused(write(tmp_path / "both.h264", first + second))
    assert "128x96 becomes 192x160" in sentence and "cut it there" in sentence


@pytest.mark.parametrize(
    ("width", "height", "codec", "pix_fmt"),
    [(853, 479, "libx264", "yuv444p"), (853, 479, "mpeg4", "yuv420p"), (2, 2, "libx264", "yuv444p"), (2, 2, "mpeg4", "yuv420p")],
)
def test_odd_and_tiny_sizes(saved: Run, make_clip: MakeClip, width: int, height: int, codec: str, pix_fmt: str) -> None:
    record = saved(make_clip(frames=2, width=width, height=height, codec=codec, pix_fmt=pix_fmt, options={}))
    assert record["frames"] == 2
    assert (record["output"]["width"], record["output"]["height"]) == (2 * width, 2 * height)


@pytest.mark.parametrize("pix_fmt", ["yuv420p10le", "yuv422p10le", "yuv444p10le"])
def test_ten_bits(refused: Callable[..., str], make_clip: MakeClip, pix_fmt: str) -> None:
    assert f"pixel format {pix_fmt} is not supported" in refused(make_clip(pix_fmt=pix_fmt, options={}))


@pytest.mark.parametrize("tags", [(2, 1, 1, 1), (1, 6, 6, 6), (1, 5, 6, 5)], ids=["full-range", "BT.601-525", "BT.601-625"])
@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv422p", "yuv444p"])
def test_colour_is_never_silently_changed(
    saved: Run, make_clip: MakeClip, tmp_path: Path, tags: tuple[int, int, int, int], pix_fmt: str
) -> None:
    clip = make_clip(tags=tags, pix_fmt=pix_fmt)
    saved(clip)
    before, after = next(read_frames(clip)), next(read_frames(tmp_path / "saved.mp4"))
    assert before.colour == after.colour
    assert (before.colour.range, before.colour.matrix) == (tags[0], tags[3])
    for low, high in ((before.u, after.u), (before.v, after.v)):
        assert abs(float(low.mean()) - float(high.mean())) < 0.5


@pytest.mark.parametrize(("height", "matrix", "said"), [(540, 2, True), (540, 6, False), (640, 2, False), (48, 2, False)])
def test_that_players_may_guess_other_colours_is_said(saved: Run, make_clip: MakeClip, height: int, matrix: int, said: bool) -> None:
    notes = saved(make_clip(width=16, height=height, frames=2, tags=(0, 2, 2, matrix)))["notes"]
    assert ("guess BT.601 up to 576 lines and BT.709 above" in str(notes)) == said


def test_output_folder_missing_or_wrong_name(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    clip = make_clip()
    assert "does not exist" in refused(clip, "-o", tmp_path / "none" / "out.mp4")
    assert "must end in .mp4 or .mkv" in refused(clip, "-o", tmp_path / "out.avi")
    (tmp_path / "folder.mp4").mkdir()
    assert "is not a file" in refused(clip, "-o", tmp_path / "folder.mp4", "--force")
    assert "File name too long" in refused(clip, "-o", tmp_path / f"{'x' * 300}.mp4")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_full_disk(make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path, suffix: str, share: float) -> None:
    """A file that may not grow stands for a disk that is full: at once, half way, and with one byte missing."""
    clip, model, output = make_clip(), model_file(), tmp_path / f"out.{suffix}"
    assert cli.main([str(clip), "-o", str(output), "--model", str(model)]) == 0
    limit_bytes = max(0, int(output.stat().st_size * share) - 1)
    output.unlink()
    before = sorted(tmp_path.iterdir())
    program = (
        "import resource, sys; from client.cli import main; "
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, {limit_bytes})); sys.exit(main())"
    )
    command = [sys.executable, "-c", program, str(clip), "-o", str(output), "--model", str(model)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (finished.returncode, finished.stdout) == (1, "")
    assert finished.stderr == f"gamesr-upscale: cannot write {output}: File too large\n"
    assert sorted(tmp_path.iterdir()) == before


def test_model_files(refused: Callable[..., str], make_clip: MakeClip, model_file: Callable[..., Path], tmp_path: Path) -> None:
    clip, whole = make_clip(), model_file("other.onnx", scale=3)
    assert "upscales by 3, not by 2" in refused(clip, "--model", whole, "--scale", "2")
    cut = write(tmp_path / "cut.onnx", whole.read_bytes()[:500])
    assert "not a readable ONNX model" in refused(clip, "--model", cut)
    assert "not a readable ONNX model" in refused(clip, "--model", write(tmp_path / "clip.onnx", clip.read_bytes()))
    foreign = model_file("foreign.onnx", metadata={"gamesr_format": None})
    assert "not a model that this client understands" in refused(clip, "--model", foreign)
    assert "cannot be read: No such file or directory" in refused(clip, "--model", tmp_path / "none.onnx")
    assert "no model named 'nonsense'" in refused(clip, "--model", "nonsense")


def test_reference_that_does_not_fit(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    clip = make_clip()
    assert "is 64x48, but the upscaled picture is 128x96" in refused(clip, "--reference", make_clip("same.mp4"))
    assert "does not exist" in refused(clip, "--reference", tmp_path / "none.mp4")
    full_range = make_clip("full.mp4", width=128, height=96, tags=(2, 1, 1, 1))
    assert "not of one colour coding" in refused(clip, "--reference", full_range)


def test_comparison_that_cannot_be_written_leaves_no_video(refused: Callable[..., str], make_clip: MakeClip, tmp_path: Path) -> None:
    clip = make_clip()
    assert "must end in" in refused(clip, "--compare", tmp_path / "wipe.jpeg")
    assert "does not exist" in refused(clip, "--compare", tmp_path / "none" / "wipe.png")
