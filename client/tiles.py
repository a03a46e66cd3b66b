"""Which tiles of a picture saw other pixels than before, and the few windows in which they are computed again."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.frames import Plane

GRAIN = 8  # luma pixels: a change is found in squares of this size, which are eight bytes of luma and four of chroma wide
MIN_TILE = 32
# What a window costs beside its area, in luma pixels of the input: measured from 1,000 (a network) to 6,000 (bicubic).
WINDOW_PIXELS = 4096
WORTH_IT = 0.875  # of a whole frame's cost: above it, copying the picture that stays takes what is saved
MAX_PIECES = 64  # more than that are not worth the time that joining them takes

Mask = NDArray[np.bool_]
Boxes = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Box:
    """Rows and columns from (top, left) to before (bottom, right), in luma pixels of the input."""

    top: int
    left: int
    bottom: int
    right: int

    def slices(self, multiply: int = 1, divide: int = 1) -> tuple[slice, slice]:
        """The same area in a plane or a tensor that has `multiply` / `divide` as many rows and columns."""
        top, left, bottom, right = (edge * multiply // divide for edge in (self.top, self.left, self.bottom, self.right))
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True, slots=True)
class Window:
    """An area to be computed: of `outer`, which has the halo around it or ends with the frame, what lies in `inner` is right."""

    inner: Box
    outer: Box

    def inside(self) -> Box:
        """`inner`, counted from the corner of `outer`."""
        top, left = self.outer.top, self.outer.left
        return Box(self.inner.top - top, self.inner.left - left, self.inner.bottom - top, self.inner.right - left)


class TileGrid:
    """A frame of `height` x `width` luma pixels, both multiples of `multiple`, cut into square tiles of at least `min_tile` pixels.

    `halo` is how far around a tile its computation looks, in pixels, a multiple of `multiple`. Tiles at the right and lower edge
    may be smaller.
    """

    def __init__(self, height: int, width: int, multiple: int, halo: int, min_tile: int = MIN_TILE) -> None:
        self.height, self.width, self.halo = height, width, halo
        self.tile = -(-min_tile // multiple) * multiple
        self.shape = -(-height // self.tile), -(-width // self.tile)
        self._seen = [self._grains(count, size) for count, size in zip(self.shape, (height, width), strict=True)]

    def plane_shapes(self) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
        """Of planes that `changed` compares: the frame's, each side filled up to whole grains."""
        height, width = (-(-size // GRAIN) * GRAIN for size in (self.height, self.width))
        return (height, width), (height // 2, width // 2), (height // 2, width // 2)

    def changed(self, before: list[Plane], after: list[Plane]) -> Mask:
        """Bool (tile rows, tile columns): where any sample of y, u or v differs in a tile or its halo.

        The planes are contiguous and have the shapes that `plane_shapes` says.
        """
        grains = _differing_rows(before[0], after[0], np.uint64, GRAIN)
        for old, new in zip(before[1:], after[1:], strict=True):
            grains |= _differing_rows(old, new, np.uint32, GRAIN // 2)
        total = np.zeros((grains.shape[0] + 1, grains.shape[1] + 1), np.int32)
        np.cumsum(np.cumsum(grains, 0, dtype=np.int32), 1, out=total[1:, 1:])
        (top, bottom), (left, right) = self._seen
        rows = total[bottom] - total[top]
        return np.asarray(rows[:, right] > rows[:, left])

    def is_in_motion(self, before: Plane, after: Plane) -> bool:
        """Whether so many tiles changed that all of a frame is to be computed, by one row of each in the luma of two frames.

        In motion that mostly tells, at a thirtieth of the time of looking at everything.
        """
        rows, columns = (size // self.tile for size in before.shape)
        old, new = (plane[self.tile // 2 : rows * self.tile : self.tile, : columns * self.tile] for plane in (before, after))
        differs = (old != new).reshape(rows, columns, self.tile).any(2)
        return bool(differs.any() and differs.mean() > WORTH_IT)

    def windows(self, due: Mask) -> list[Window] | None:
        """Windows that hold every tile of `due`, at the least cost that joining neighbours finds; None for the whole frame."""
        pieces = _pieces(due)
        if due.all() or len(pieces) > MAX_PIECES:
            return None
        boxes = self._joined(pieces)
        if self._cost(boxes).sum() > WORTH_IT * (self.height * self.width + WINDOW_PIXELS):
            return None
        inner, outer = self._pixels(boxes, 0), self._pixels(boxes, self.halo)
        return [Window(Box(*a), Box(*b)) for a, b in zip(inner.tolist(), outer.tolist(), strict=True)]

    def held(self, windows: Sequence[Window]) -> Mask:
        """The tiles that the windows' inner areas are made of."""
        mask = np.zeros(self.shape, bool)
        for window in windows:
            box = window.inner
            mask[box.top // self.tile : -(-box.bottom // self.tile), box.left // self.tile : -(-box.right // self.tile)] = True
        return mask

    def _grains(self, count: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First grain, and the one behind the last, of what each of `count` tiles of an axis looks at."""
        first = np.arange(count) * self.tile
        return np.maximum(first - self.halo, 0) // GRAIN, -(-np.minimum(first + self.tile + self.halo, size) // GRAIN)

    def _joined(self, pieces: Boxes) -> Boxes:
        """Boxes in tiles: each piece in its turn joined with the box that saves most by it, as long as one saves anything."""
        boxes = pieces[:1]
        for piece in pieces[1:]:
            box = piece[None]
            while len(boxes):
                unions = np.concatenate((np.minimum(boxes[:, :2], box[:, :2]), np.maximum(boxes[:, 2:], box[:, 2:])), 1)
                saved = self._cost(boxes) + self._cost(box) - self._cost(unions)
                best = int(saved.argmax())
                if saved[best] < 0:
                    break
                box, boxes = unions[best : best + 1], np.delete(boxes, best, 0)
            boxes = np.concatenate((boxes, box))
        return boxes

    def _cost(self, boxes: Boxes) -> NDArray[np.int64]:
        edges = self._pixels(boxes, self.halo)
        return np.asarray((edges[:, 2] - edges[:, 0]) * (edges[:, 3] - edges[:, 1]) + WINDOW_PIXELS)

    def _pixels(self, boxes: Boxes, around: int) -> Boxes:
        """Boxes in tiles as boxes in pixels, `around` pixels larger each way, within the frame."""
        edges = boxes * self.tile + np.array((-around, -around, around, around))
        within: Boxes = np.clip(edges, 0, np.array((self.height, self.width, self.height, self.width)))
        return within


def _differing_rows(before: Plane, after: Plane, word: type[np.unsignedinteger], rows: int) -> Mask:
    """Bool (height / rows, width / the bytes of `word`): where two planes differ."""
    words = before.view(word) != after.view(word)
    return np.asarray(words.reshape(-1, rows, words.shape[1]).any(1))


def _pieces(due: Mask) -> Boxes:
    """(N, 4) top, left, bottom, right in tiles: the runs of each band of equal rows."""
    starts = np.flatnonzero(np.concatenate(([True], (due[1:] != due[:-1]).any(1), [True])))
    pieces = []
    for top, bottom in itertools.pairwise(starts):
        turns = np.flatnonzero(np.diff(due[top].astype(np.int8), prepend=0, append=0))
        pieces += [(top, left, bottom, right) for left, right in zip(turns[::2], turns[1::2], strict=True)]
    return np.array(pieces, np.int64).reshape(-1, 4)
