"""Packets to frames: formats, sizes, tags, and streams that are not whole."""

from __future__ import annotations

import gc
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame

from client.chroma import halve_rows, halve_rows_and_columns
from client.errors import InputError
from client.frames import ColourTags, Frame
from client.video import VideoSource, from_av_frame, read_frames, to_av_frame
from tests.conftest import FRAMES, HEIGHT, WIDTH, picture

MakeClip = Callable[..., Path]


def drain(path: Path) -> tuple[list[Frame], int]:
    with VideoSource(path) as source:
        frames = [decoded.frame for decoded in source]
    return frames, source.decode_errors


def random_plane(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize("options", [{"bf": "0"}, {"bf": "3", "b-adapt": "0"}, {"tune": "zerolatency", "slices": "4"}])
def test_every_frame_comes_out_once_and_in_order(make_clip: MakeClip, options: dict[str, str]) -> None:
    pts = [0, 1, 2, 5, 6, 9, 10, 11, 12, 20, 21, 22]
    frames, errors = drain(make_clip(pts=pts, options=options))
    assert errors == 0
    assert [frame.pts * frame.time_base for frame in frames] == [Fraction(p, 30) for p in pts]
    assert not any(frame.damaged for frame in frames)


def test_a_picture_is_freed_without_the_garbage_collector(make_clip: MakeClip) -> None:
    def alive() -> int:
        return sum(type(thing) is VideoFrame for thing in gc.get_objects())

    clip = make_clip()
    gc.collect()
    gc.disable()
    try:
        before = alive()
        assert max(alive() - before for _ in read_frames(clip)) <= 3
    finally:
        gc.enable()


def test_source_says_what_it_holds(make_clip: MakeClip) -> None:
    with VideoSource(make_clip(sample_aspect_ratio=Fraction(4, 3), rotation=90)) as source:
        assert (source.width, source.height, source.announced_frames) == (WIDTH, HEIGHT, FRAMES)
        assert source.estimated_frames == FRAMES
        assert (source.frame_rate, source.sample_aspect_ratio) == (30, Fraction(4, 3))
        assert source.display_matrix is None
        next(iter(source))
        assert source.display_matrix is not None and source.display_matrix[0] == 0


def test_frames_are_estimated_where_the_container_does_not_count_them(make_clip: MakeClip) -> None:
    with VideoSource(make_clip("clip.mkv")) as source:
        assert (source.announced_frames, source.estimated_frames) == (None, FRAMES)


def test_stamps_are_in_order(make_clip: MakeClip) -> None:
    with VideoSource(make_clip(options={"bf": "3"})) as source:
        stamps = [stamp for decoded in source for stamp in (decoded.packet_ns, decoded.decoded_ns)]
    assert stamps == sorted(stamps) and len(stamps) == 2 * FRAMES


def test_what_an_edit_list_cuts_off_is_not_announced(make_clip: MakeClip) -> None:
    """Pictures behind the last key frame before the cut are decoded and not shown, those before it not read at all."""
    path = make_clip(options={"g": "6", "bf": "2"})
    with av.open(str(path)) as container:
        ticks = round(1 / (30 * container.streams.video[0].time_base))
    content = bytearray(path.read_bytes())
    begin = content.index(b"elst") + 16  # of the only edit, in the track's own time
    shown = int.from_bytes(content[begin : begin + 4], "big")
    for cut in (2, 8):
        content[begin : begin + 4] = (shown + cut * ticks).to_bytes(4, "big")
        path.write_bytes(content)
        with VideoSource(path) as source:
            assert source.announced_frames == source.estimated_frames == len(list(source)) == FRAMES - cut


@pytest.mark.parametrize("tags", [(1, 1, 1, 1), (2, 1, 1, 1), (1, 5, 6, 5), (1, 6, 6, 6), (0, 2, 2, 2)])
def test_colour_tags_go_through(make_clip: MakeClip, tags: tuple[int, int, int, int]) -> None:
    frame = next(read_frames(make_clip(tags=tags)))
    assert frame.colour == ColourTags(range=tags[0], primaries=tags[1], transfer=tags[2], matrix=tags[3])


def test_full_range_formats_are_full_range_whatever_their_tag() -> None:
    assert from_av_frame(av.VideoFrame(4, 4, "yuvj420p")).colour.range == 2


def test_full_range_format_is_tagged_full(make_clip: MakeClip) -> None:
    path = make_clip("clip.avi", codec="mjpeg", pix_fmt="yuvj420p", options={"qscale": "2"}, tags=(2, 2, 2, 2))
    assert next(read_frames(path)).colour.range == 2


@pytest.mark.parametrize(
    ("pix_fmt", "width", "height"),
    [("yuv422p", 64, 48), ("yuv422p", 854, 479), ("yuv444p", 64, 48), ("yuv444p", 853, 479), ("yuv444p", 5, 3), ("yuv444p", 2, 2)],
)
def test_other_subsamplings_become_420(make_clip: MakeClip, pix_fmt: str, width: int, height: int) -> None:
    path = make_clip(frames=2, width=width, height=height, pix_fmt=pix_fmt)
    with av.open(str(path)) as container:
        planes = [plane_of(plane) for plane in next(container.decode(video=0)).planes]
    frame = next(read_frames(path))
    halve = halve_rows if pix_fmt == "yuv422p" else halve_rows_and_columns
    for got, expected in zip((frame.y, frame.u, frame.v), (planes[0], halve(planes[1]), halve(planes[2])), strict=True):
        assert np.array_equal(got, expected)
    assert (frame.height, frame.width) == (height, width)
    assert frame.u.shape == frame.v.shape == (-(-height // 2), -(-width // 2))


def plane_of(plane: av.video.plane.VideoPlane) -> np.ndarray:
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width].copy()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 2), (3, 5), (4, 7), (48, 64)])
def test_chroma_filter_is_121_about_even_columns_and_the_mean_of_row_pairs(height: int, width: int) -> None:
    plane = random_plane(height, width)
    padded = np.pad(plane.astype(float), ((0, height % 2), (1, 1 + width % 2)), mode="edge")
    rows = (padded[0::2] + padded[1::2]) / 2
    columns = (rows[:, 0:-2] + 2 * rows[:, 1:-1] + rows[:, 2:])[:, ::2] / 4
    assert np.array_equal(halve_rows_and_columns(plane), np.floor(columns[:, : -(-width // 2)] + 0.5))
    assert np.array_equal(halve_rows(plane), np.floor(rows[:, 1 : 1 + width] + 0.5))


def test_chroma_filter_keeps_left_siting() -> None:
    ramp = np.tile(np.arange(0, 128, 2, dtype=np.uint8), (4, 1))
    assert np.array_equal(halve_rows_and_columns(ramp)[:, 1:], ramp[::2, 2::2])


def test_nv12_equals_its_planes() -> None:
    planar = picture(3, 62, 46)
    interleaved = av.VideoFrame(62, 46, "nv12")
    frame = from_av_frame(planar)
    chroma = np.frombuffer(interleaved.planes[1], np.uint8).reshape(-1, interleaved.planes[1].line_size)
    np.frombuffer(interleaved.planes[0], np.uint8).reshape(-1, interleaved.planes[0].line_size)[:, :62] = frame.y
    chroma[:, 0:62:2], chroma[:, 1:62:2] = frame.u, frame.v
    twin = from_av_frame(interleaved)
    assert all(np.array_equal(a, b) for a, b in zip((frame.y, frame.u, frame.v), (twin.y, twin.u, twin.v), strict=True))


def test_to_and_from_av_keeps_everything() -> None:
    frame = Frame(random_plane(5, 7), random_plane(3, 4), random_plane(3, 4), 41, Fraction(1, 90000), ColourTags(2, 5, 6, 5))
    twin = from_av_frame(to_av_frame(frame))
    assert (twin.pts, twin.time_base, twin.colour) == (frame.pts, frame.time_base, frame.colour)
    assert all(np.array_equal(a, b) for a, b in zip((frame.y, frame.u, frame.v), (twin.y, twin.u, twin.v), strict=True))


def test_odd_mpeg4_is_read(make_clip: MakeClip) -> None:
    frames, errors = drain(make_clip(codec="mpeg4", width=853, height=479, frames=2, options={"qscale": "2"}))
    assert (len(frames), errors, frames[0].y.shape, frames[0].u.shape) == (2, 0, (479, 853), (240, 427))


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "decoded_as"),
    [
        ("libx264", "yuv420p10le", "yuv420p10le"),
        ("libx264rgb", "rgb24", "gbrp"),
        ("ffv1", "gray", "gray"),
        ("ffv1", "yuva420p", "yuva420p"),
    ],
)
def test_other_pixel_formats_are_refused_by_name(make_clip: MakeClip, codec: str, pix_fmt: str, decoded_as: str) -> None:
    path = make_clip("clip.mkv", codec=codec, pix_fmt=pix_fmt, frames=2, options={}, tags=(0, 2, 2, 0 if decoded_as == "gbrp" else 2))
    with pytest.raises(InputError, match=f"pixel format {decoded_as} is not supported"):
        VideoSource(path)


def test_monochrome_h264_has_neutral_chroma(make_clip: MakeClip) -> None:
    frame = next(read_frames(make_clip(pix_fmt="gray", options={})))
    assert (frame.u == 128).all() and (frame.v == 128).all() and np.ptp(frame.y) > 50


INTERLACED = {"flags": "+ildct+ilme", "x264-params": "tff=1"}


def test_interlaced_is_refused_by_name(make_clip: MakeClip, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="interlaced"):
        VideoSource(make_clip(options=INTERLACED))
    later = tmp_path / "later.h264"
    later.write_bytes(make_clip("a.h264").read_bytes() + make_clip("b.h264", options=INTERLACED).read_bytes())
    with pytest.raises(InputError, match="interlaced"):
        drain(later)


def test_too_large_is_refused_before_it_is_decoded(make_clip: MakeClip) -> None:
    with pytest.raises(InputError, match="8200x16"):
        VideoSource(make_clip(width=8200, height=16, frames=1))


def test_a_broken_packet_costs_no_other_frame(make_clip: MakeClip, tmp_path: Path) -> None:
    """Damage is marked from the broken packet to the next key frame; what came before and after is what it was."""
    path = make_clip("clip.mkv")
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    content = path.read_bytes()
    assert content.count(packets[8]) == 1
    broken = tmp_path / "broken.mkv"
    broken.write_bytes(content.replace(packets[8], bytes(len(packets[8]))))
    whole, _ = drain(path)
    frames, errors = drain(broken)
    assert errors == 1
    assert len(frames) == FRAMES - 1
    assert [frame.damaged for frame in frames] == [False] * 8 + [True] * 3
    for index in range(8):
        assert np.array_equal(frames[index].y, whole[index].y)


def test_damage_ends_at_a_key_frame(make_clip: MakeClip, tmp_path: Path) -> None:
    path = make_clip("clip.mkv")
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    broken = tmp_path / "broken.mkv"
    broken.write_bytes(path.read_bytes().replace(packets[2], bytes(len(packets[2]))))
    frames, errors = drain(broken)
    assert errors == 1
    assert [frame.damaged for frame in frames] == [False] * 2 + [True] * 3 + [False] * 6


@pytest.mark.parametrize("seed", range(8))
def test_flipped_bits_never_stop_decoding(make_clip: MakeClip, tmp_path: Path, seed: int) -> None:
    content = bytearray(make_clip("clip.h264").read_bytes())
    rng = np.random.default_rng(seed)
    for position in rng.integers(len(content) // 3, len(content), 10):
        content[position] ^= 1 << int(rng.integers(8))
    damaged = tmp_path / "damaged.h264"
    damaged.write_bytes(content)
    frames, _ = drain(damaged)
    assert FRAMES // 3 <= len(frames) <= FRAMES


def test_missing_and_garbage_packets(make_clip: MakeClip, tmp_path: Path) -> None:
    packets = annex_b_packets(make_clip("clip.h264"))
    garbage = np.random.default_rng(0).integers(0, 256, 700, dtype=np.uint8).tobytes()
    holes = tmp_path / "holes.h264"
    holes.write_bytes(b"".join(packets[:3] + packets[5:7] + [garbage] + packets[7:]))
    frames, _ = drain(holes)
    assert len(frames) == FRAMES - 2


def annex_b_packets(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def test_streams_without_timestamps_have_none(make_clip: MakeClip) -> None:
    frames, _ = drain(make_clip("clip.h264"))
    assert [frame.pts for frame in frames] == [None] * FRAMES


def test_a_size_change_comes_out_as_it_is(make_clip: MakeClip, tmp_path: Path) -> None:
    both = tmp_path / "both.h264"
    both.write_bytes(make_clip("a.h264").read_bytes() + make_clip("b.h264", width=96, height=80).read_bytes())
    frames, errors = drain(both)
    assert errors == 0
    assert [frame.y.shape for frame in frames] == [(48, 64)] * FRAMES + [(80, 96)] * FRAMES


@pytest.mark.parametrize("name", ["list.m3u8", "list.mp4"])
@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{clip}\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile '{clip}'\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
    ],
)
def test_a_list_of_other_files_reaches_none_of_them(make_clip: MakeClip, tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text.format(clip=make_clip("clip.ts")))
    with pytest.raises(InputError, match="not a video file that can be opened"):
        VideoSource(path)


def test_a_name_is_never_an_address(make_clip: MakeClip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_clip().rename(tmp_path / "concat:a.mp4")
    assert len(drain(Path("concat:a.mp4"))[0]) == FRAMES
    with pytest.raises(InputError, match="does not exist"):
        VideoSource(Path("http://127.0.0.1:9/clip.mp4"))
