"""What is measured against or learnt from has to be whole and of one size, whoever reads it; what is sent, of one size."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import pytest

from client.cloud import NetworkSettings
from client.errors import InputError
from client.models import find_model
from client.reference import Reference
from client.stream_source import EncodedLive
from client.video import VideoSource, read_frames
from model.footage import Degradation, FootageCache, Scene
from model.quantize import quantize
from server.encoding import clip_frames
from server.probe import probe
from server.settings import Limits
from tests.conftest import FRAMES, HEIGHT, WIDTH

MakeClip = Callable[..., Path]


def as_reference(path: Path) -> None:
    with Reference(path, WIDTH, HEIGHT, ("ours",)) as reference:
        for frame in list(read_frames(path)):
            reference.add({"ours": frame})
        reference.result()


def as_native_render(path: Path) -> None:
    twice = path.with_name("twice.mkv")
    FootageCache(path.parent / "cache").degraded(Scene("s", "g", "test", 30, twice, {HEIGHT: path}), 2, Degradation("native"))


def as_calibration(path: Path) -> None:
    quantize(find_model("fast", 2), path.with_name("int8.onnx"), [path], name="int8", frames=2 * FRAMES, made_frames=1)


READERS: list[Callable[[Path], object]] = [
    as_reference,
    lambda path: list(clip_frames(path, 1, None)),
    lambda path: FootageCache(path.parent / "cache").reference(Scene("s", "g", "test", 30, path)),
    as_native_render,
    lambda path: probe(path, Limits(), whole=True),
    as_calibration,
]
each_reader = pytest.mark.parametrize("read", READERS, ids=["reference", "sweep", "footage", "native", "probe", "calibration"])


@pytest.fixture
def twice(make_clip: MakeClip) -> Path:
    return make_clip("twice.mkv", frames=2 * FRAMES, width=2 * WIDTH, height=2 * HEIGHT)


@pytest.fixture
def two_sizes(make_clip: MakeClip, tmp_path: Path) -> Path:
    both = tmp_path / "both.h264"
    both.write_bytes(make_clip("a.h264").read_bytes() + make_clip("b.h264", width=96, height=80).read_bytes())
    return both


@each_reader
@pytest.mark.parametrize("refused_packet", [True, False])
def test_a_damaged_film_is_refused(read: Callable[[Path], object], make_clip: MakeClip, twice: Path, refused_packet: bool) -> None:
    """Whether its decoder refuses a packet or only marks the picture that it made of one."""
    path = make_clip("clip.mkv", frames=2 * FRAMES)
    with av.open(str(path)) as container:
        packet = [bytes(packet) for packet in container.demux(video=0) if packet.size][8]
    kept = 0 if refused_packet else len(packet) // 2
    path.write_bytes(path.read_bytes().replace(packet, packet[:kept] + bytes(len(packet) - kept)))
    with VideoSource(path) as source:
        marked = [decoded.frame.damaged for decoded in source]
    assert any(marked) and source.decode_errors == refused_packet
    with pytest.raises(InputError, match=r"clip(\.mkv)? is damaged"):
        read(path)


@each_reader
def test_a_film_of_two_sizes_is_refused(read: Callable[[Path], object], two_sizes: Path, twice: Path) -> None:
    with pytest.raises(InputError, match="changes its size in mid-stream, from 64x48 to 96x80"):
        read(two_sizes)


@pytest.mark.parametrize("height", [HEIGHT, HEIGHT // 2])
def test_a_clip_of_two_sizes_is_sent_up_to_there(two_sizes: Path, height: int) -> None:
    source = EncodedLive(two_sizes, height, NetworkSettings(1000, 30))
    for _ in range(FRAMES - 1):
        source.take(idr=False)
    with pytest.raises(InputError, match="changes its size"):
        source.take(idr=False)


def test_what_a_sweep_does_not_count_may_be_of_any_size(two_sizes: Path) -> None:
    assert len(list(clip_frames(two_sizes, 1, FRAMES))) == FRAMES
    assert len(list(clip_frames(two_sizes, 4, 3))) == 3 and next(clip_frames(two_sizes, 5, None)).width == WIDTH
