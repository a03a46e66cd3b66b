"""Comparison pictures and videos: the right halves, the right colours, whole files only."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from client.compare import ComparisonWriter
from client.errors import GamesrError, InputError, OutputError
from client.frames import BT709_LIMITED, ColourTags, Frame
from client.lettering import letters
from client.rgb import to_rgb
from client.video import VideoSource, read_frames

WIDTH, HEIGHT, FRAMES = 128, 96, 5


def flat(luma: int, width: int = WIDTH, height: int = HEIGHT, u: int = 128, v: int = 128) -> Frame:
    chroma = (-(-height // 2), -(-width // 2))
    return Frame(np.full((height, width), luma, np.uint8), np.full(chroma, u, np.uint8), np.full(chroma, v, np.uint8))


@pytest.fixture
def source(make_clip: Callable[..., Path]) -> Iterator[VideoSource]:
    with VideoSource(make_clip(width=WIDTH, height=HEIGHT, frames=FRAMES)) as source:
        yield source


def read_png(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return next(container.decode(video=0)).to_ndarray(format="rgb24")


@pytest.mark.parametrize(("matrix", "kr", "kb"), [(1, 0.2126, 0.0722), (2, 0.2126, 0.0722), (6, 0.299, 0.114), (9, 0.2627, 0.0593)])
@pytest.mark.parametrize("full", [False, True])
def test_rgb_undoes_the_matrix_that_the_tags_name(matrix: int, kr: float, kb: float, full: bool) -> None:
    """The forward equations of H.273 on colours inside the cube; quantising to 8 bits costs up to 2 code values."""
    for red, green, blue in np.random.default_rng(0).integers(20, 236, (50, 3)) / 255:
        luma = kr * red + (1 - kr - kb) * green + kb * blue
        cb, cr = (blue - luma) / (2 * (1 - kb)), (red - luma) / (2 * (1 - kr))
        codes = (255 * luma, 255 * cb + 128, 255 * cr + 128) if full else (219 * luma + 16, 224 * cb + 128, 224 * cr + 128)
        y, u, v = (round(code) for code in codes)
        planes = flat(y, 4, 4, u, v)
        picture = to_rgb(Frame(planes.y, planes.u, planes.v, colour=ColourTags(2 if full else 1, matrix, matrix, matrix)))
        assert np.abs(picture - 255 * np.array([red, green, blue])).max() <= 2


def test_chroma_is_raised_from_its_left_sited_position() -> None:
    """A ramp stays a ramp: column x of the picture lies at chroma column x / 2, row y at chroma row (y - 0.5) / 2."""
    rows, columns = np.mgrid[0:8, 0:16]
    grey = flat(128, 32, 16)
    tagged = ColourTags(range=2, matrix=1)
    for ramp, expected in (
        (60 + 8 * columns, 60 + 4.0 * np.arange(31)[None, :]),
        (60 + 16 * rows, 52 + 8.0 * np.arange(1, 15)[:, None] + 4),
    ):
        picture = to_rgb(Frame(grey.y, grey.u, ramp.astype(np.uint8), colour=tagged)).astype(float)
        inner = picture[1:15, :31, 0]
        assert np.abs(inner - np.clip(128 + 2 * (1 - 0.2126) * (expected - 128), 0, 255)).max() <= 0.51


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (2, 2)])
def test_rgb_of_odd_sizes(height: int, width: int) -> None:
    assert (to_rgb(flat(126, width, height)) == 128).all()


def test_letters_are_readable() -> None:
    drawn = ["".join(" #"[int(dot)] for dot in row) for row in letters("Hi\N{SNOWMAN}", 1)]
    assert drawn[0] == "#   #   #    ###  " and drawn[3] == "#####   #      #  "
    assert letters("ab", 3).shape == (21, 36)


def test_picture_shows_left_and_right_of_the_frame_that_differs_most(tmp_path: Path, source: VideoSource) -> None:
    path = tmp_path / "wipe.png"
    with ComparisonWriter(path, source, labels=("a", "b")) as comparison:
        for left, right in ((100, 101), (60, 180), (90, 70)):
            comparison.add(flat(left), flat(right))
    picture = read_png(path)
    assert picture.shape[1:] == (WIDTH, 3) and picture.shape[0] > HEIGHT * 3 / 2
    left, right = ((code - 16) / 219 * 255 for code in (60, 180))
    assert np.abs(picture[HEIGHT // 2, [20, WIDTH // 2 - 2]] - left).max() <= 1
    assert np.abs(picture[HEIGHT // 2, [WIDTH // 2 + 1, WIDTH - 4]] - right).max() <= 1
    assert (picture[HEIGHT // 2, [WIDTH // 2 - 1, WIDTH // 2]] == 255).all()
    assert np.abs(picture[-2, [10, WIDTH - 10], 0] - [left, right]).max() <= 1


def test_picture_magnifies_the_area_that_differs_most(tmp_path: Path, source: VideoSource) -> None:
    left, right = flat(50), flat(50)
    right.y[60:72, 96:112] = 200
    with ComparisonWriter(tmp_path / "wipe.png", source) as comparison:
        comparison.add(left, right)
    picture = read_png(tmp_path / "wipe.png")
    details = picture[HEIGHT + 2 + 13 :, :]  # below the labels
    assert (details[:, WIDTH // 2 + 2 :] == details[-1, -1]).all() and details[-1, -1, 0] == round(184 / 219 * 255)
    assert details[-1, 0, 0] == round(34 / 219 * 255)
    assert (picture[59, 95:113] == 255).all() and (picture[72, 95:113] == 255).all()


def test_video_keeps_time_and_shows_both_halves(tmp_path: Path, source: VideoSource) -> None:
    path, times = tmp_path / "wipe.mp4", []
    with ComparisonWriter(path, source) as comparison:
        for item in source:
            frame = item.frame
            times.append(frame.pts * frame.time_base)
            grey = flat(60)
            comparison.add(grey, Frame(flat(180).y, grey.u, grey.v, frame.pts, frame.time_base, BT709_LIMITED))
    shown = list(read_frames(path))
    assert [frame.pts * frame.time_base for frame in shown] == times and len(times) == FRAMES
    for frame in shown:
        assert frame.colour.matrix == 1
        assert np.abs(frame.y[40:, 4:56] - 60.0).max() <= 3 and np.abs(frame.y[40:, 72:] - 180.0).max() <= 3
        assert frame.y[40:, 63:65].min() > 220


@pytest.mark.parametrize("name", ["odd.png", "odd.mp4"])
@pytest.mark.parametrize(("width", "height"), [(2, 2), (3, 3), (53, 31), (64, 2)])
def test_tiny_and_odd_pictures_are_drawn(tmp_path: Path, source: VideoSource, name: str, width: int, height: int) -> None:
    with ComparisonWriter(tmp_path / name, source) as comparison:
        comparison.add(flat(60, width, height), flat(180, width, height))
    assert (tmp_path / name).stat().st_size > 0


@pytest.mark.parametrize("name", ["wipe.png", "wipe.mp4"])
def test_files_appear_whole_or_not_at_all(tmp_path: Path, source: VideoSource, name: str) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    path = folder / name
    with pytest.raises(KeyboardInterrupt), ComparisonWriter(path, source) as comparison:
        comparison.add(flat(60), flat(180))
        raise KeyboardInterrupt
    with pytest.raises(OutputError, match="no frame"), ComparisonWriter(path, source):
        pass
    with pytest.raises(InputError, match="128x96 with one of 64x96"), ComparisonWriter(path, source) as comparison:
        comparison.add(flat(60), flat(180, 64))
    assert not list(folder.iterdir())

    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists"):
        ComparisonWriter(path, source)
    assert path.read_bytes() == b"precious"
    with ComparisonWriter(path, source, force=True) as comparison:
        comparison.add(flat(60), flat(180))
    assert path.stat().st_size > 100 and list(folder.iterdir()) == [path]


@pytest.mark.parametrize("name", ["wipe.gif", "wipe", "missing/wipe.png", "missing/wipe.mp4"])
def test_a_target_that_cannot_be_is_refused_at_once(tmp_path: Path, source: VideoSource, name: str) -> None:
    with pytest.raises(GamesrError, match="cannot write") as caught:
        ComparisonWriter(tmp_path / name, source)
    assert "\n" not in str(caught.value)


def test_a_folder_that_takes_no_file_is_one_sentence(tmp_path: Path, source: VideoSource) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    with (
        pytest.raises(OutputError, match=r"cannot write .*wipe\.png: No such file"),
        ComparisonWriter(folder / "wipe.png", source) as comparison,
    ):
        comparison.add(flat(60), flat(180))
        folder.rmdir()
