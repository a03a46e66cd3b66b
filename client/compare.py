"""What the network buys, for the eye: two clips of one scene wiped over each other, as a video or as one picture."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from client import lettering
from client.errors import InputError, OutputError
from client.frames import Frame, Plane
from client.quality import squared_error
from client.rgb import RgbPicture, to_png, to_rgb
from client.sink import MUXERS, FileSink
from client.video import OpenVideo
from client.whole_file import landing, write_whole

AREA_FRACTION = 8
MAGNIFICATION = 4
LINES_PER_DOT = 360  # one dot of a letter is as high as a 360th of the picture


class ComparisonWriter:
    """Writes the left half of one clip and the right half of another, with a line between them and a label in each.

    `path` ends in .mp4 or .mkv for a video of every frame, made by a `FileSink` with the time and sound of `source`; or in
    .png for one picture: the frame where the lumas of the two differ most in the mean square and, below it, the area (an
    eighth of the width and height) where they differ most, 4 times magnified from both by repeating pixels. A context
    manager: the file is there, whole, after the block, and not at all if an exception ended it. `labels` name left and
    right in printable ASCII.

    Raises OutputError, in one sentence, for another suffix, a path that exists (unless `force`) or is the input, a folder
    that is missing or full, and when no frame came.
    """

    def __init__(self, path: Path, source: OpenVideo, *, labels: tuple[str, str] = ("bicubic", "GameSR"), force: bool = False) -> None:
        suffix = path.suffix.lower()
        if suffix not in (".png", *MUXERS):
            raise OutputError(f"cannot write {path}: the name of a comparison must end in .png or {' or '.join(MUXERS)}")
        self._path = path
        self._frames = 0
        self._target: _OnePicture | _WipedVideo
        if suffix == ".png":
            self._target = _OnePicture(path, labels, force)
        else:
            self._target = _WipedVideo(FileSink(path, source, force=force), labels)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._target.close(kind, error, trace)
        if kind is None and not self._frames:
            raise OutputError(f"{self._path} was not written: there was no frame to compare")

    def add(self, left: Frame, right: Frame) -> None:
        """Show one frame of each clip. Raises InputError where their sizes differ, OutputError where it cannot be written."""
        if left.y.shape != right.y.shape:
            raise InputError(f"cannot compare a picture of {left.width}x{left.height} with one of {right.width}x{right.height}")
        self._target.add(left, right, self._frames)
        self._frames += 1


class _WipedVideo:
    def __init__(self, sink: FileSink, labels: tuple[str, str]) -> None:
        self._sink, self._labels = sink, labels
        self._overlay = _Overlay(0, 0)

    def add(self, left: Frame, right: Frame, index: int) -> None:
        wiped = _wipe(left, right)
        if self._overlay.shape != wiped.y.shape:
            self._overlay = _Overlay(wiped.height, wiped.width)
            _label_wipe(self._overlay, self._labels, wiped.height, wiped.width)
        self._overlay.draw_on_planes(wiped)
        self._sink.write(wiped)

    def close(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._sink.__exit__(kind, error, trace)


class _OnePicture:
    def __init__(self, path: Path, labels: tuple[str, str], force: bool) -> None:
        folder = landing(path).parent
        if not folder.is_dir():
            raise OutputError(f"cannot write {path}: the folder {folder} does not exist")
        if not os.access(folder, os.W_OK):  # it is written when all is done: too late to be told
            raise OutputError(f"cannot write {path}: the folder {folder} may not be written to")
        if os.path.lexists(path) and not force:
            raise OutputError(f"{path} exists: name another file with --compare, or replace it with --force")
        self._path, self._labels = path, labels
        self._most = -1
        self._chosen: tuple[Frame, Frame, int] | None = None

    def add(self, left: Frame, right: Frame, index: int) -> None:
        difference = squared_error(left.y, right.y)
        if difference > self._most:
            self._most = difference
            self._chosen = _copy(left), _copy(right), index

    def close(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if kind is not None or self._chosen is None:
            return
        write_whole(self._path, to_png(_compose(*self._chosen, self._labels)))


class _Overlay:
    """White letters and lines on black, laid over a picture of one size; what falls outside is cut off."""

    def __init__(self, height: int, width: int) -> None:
        self.shape = (height, width)
        self._white = np.zeros((height, width), bool)
        self._black = np.zeros((height, width), bool)

    def write(self, text: str, row: int, column: int, dot: int) -> None:
        letters = lettering.letters(text, dot)
        rows, columns = letters.shape
        self._black[max(0, row - 2 * dot) : row + rows + 2 * dot, max(0, column - 2 * dot) : column + columns + dot] = True
        target = self._white[row : row + rows, column : column + columns]
        target |= letters[: target.shape[0], : target.shape[1]]

    def line(self, rows: slice, columns: slice) -> None:
        self._white[rows, columns] = True

    def box(self, area: tuple[slice, slice], thickness: int) -> None:
        """A line about the outside of an area."""
        rows, columns = (slice(max(0, side.start - thickness), side.stop + thickness) for side in area)
        inside = self._white[area].copy()
        self._white[rows, columns] = True
        self._white[area] = inside

    def draw_on_planes(self, frame: Frame) -> None:
        black, white = (0, 255) if frame.colour.range == 2 else (16, 235)
        frame.y[self._black] = black
        frame.y[self._white] = white
        covered = (self._black | self._white)[::2, ::2]
        frame.u[covered] = 128
        frame.v[covered] = 128

    def draw_on_rgb(self, picture: RgbPicture) -> None:
        picture[self._black] = 0
        picture[self._white] = 255


def _label_wipe(overlay: _Overlay, labels: tuple[str, str], height: int, width: int) -> None:
    """A label in the upper left corner of each half, and the line between the halves."""
    middle, dot = _middle(width), _dot(height)
    overlay.line(slice(0, height), slice(max(0, middle - dot), middle + dot))
    overlay.write(labels[0], 4 * dot, 4 * dot, dot)
    overlay.write(labels[1], 4 * dot, middle + 5 * dot, dot)


def _dot(height: int) -> int:
    return max(1, height // LINES_PER_DOT)


def _middle(width: int) -> int:
    """Where the right half begins: an even column, so that no chroma sample belongs to both."""
    return width // 4 * 2


def _wipe(left: Frame, right: Frame) -> Frame:
    middle = _middle(right.width)

    def join(a: Plane, b: Plane, column: int) -> Plane:
        return np.concatenate((a[:, :column], b[:, column:]), axis=1)

    u, v = join(left.u, right.u, middle // 2), join(left.v, right.v, middle // 2)
    return Frame(join(left.y, right.y, middle), u, v, right.pts, right.time_base, right.colour)


def _compose(left: Frame, right: Frame, index: int, labels: tuple[str, str]) -> RgbPicture:
    """The wiped frame above, the magnified area of left and of right below."""
    height, width = left.y.shape
    dot, middle = _dot(height), _middle(width)
    area = _area_of_greatest_difference(left.y, right.y)
    pictures = to_rgb(left), to_rgb(right)
    details = [picture[area].repeat(MAGNIFICATION, 0).repeat(MAGNIFICATION, 1) for picture in pictures]
    below, half = height + 2 * dot, details[0].shape[1]
    canvas = np.zeros((below + details[0].shape[0], max(width, 2 * half), 3), np.uint8)
    overlay = _Overlay(*canvas.shape[:2])
    canvas[:height, :middle], canvas[:height, middle:width] = pictures[0][:, :middle], pictures[1][:, middle:]
    overlay.box(area, dot)
    _label_wipe(overlay, labels, height, width)
    overlay.write(f"frame {index}", height - 11 * dot, 4 * dot, dot)
    for detail, label, start in zip(details, labels, (0, half), strict=True):
        canvas[below:, start : start + half] = detail
        overlay.write(f"{label}, {MAGNIFICATION}x", below + 4 * dot, start + 5 * dot, dot)
    overlay.line(slice(height, below), slice(None))
    overlay.line(slice(below, None), slice(half - dot, half + dot))
    overlay.draw_on_rgb(canvas)
    return canvas


def _area_of_greatest_difference(left: Plane, right: Plane) -> tuple[slice, slice]:
    """Rows and columns, an eighth of the picture each way, where the absolute luma difference sums highest."""
    height, width = left.shape
    rows, columns = max(1, height // AREA_FRACTION), max(1, width // AREA_FRACTION)
    difference = np.abs(np.subtract(left, right, dtype=np.int16))
    total = np.pad(difference.cumsum(0, dtype=np.int64).cumsum(1), ((1, 0), (1, 0)))
    sums = total[rows:, columns:] - total[:-rows, columns:] - total[rows:, :-columns] + total[:-rows, :-columns]
    top, start = (int(i) for i in np.unravel_index(int(sums.argmax()), sums.shape))
    return slice(top, top + rows), slice(start, start + columns)


def _copy(frame: Frame) -> Frame:
    return Frame(frame.y.copy(), frame.u.copy(), frame.v.copy(), frame.pts, frame.time_base, frame.colour)
