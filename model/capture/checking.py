"""Is a filmed scene worth keeping: does it move, does it show something, and are its sizes the same frames?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.errors import InputError
from client.frames import Plane
from client.quality import psnr_db
from client.video import read_frames

STILL = 0.3  # mean absolute change of luma from frame to frame, in code values, below which nothing goes on
EMPTY = 0.4  # mean absolute second difference of luma, in code values: a black picture, a plain sky
MOVING_SHARE = 2 / 3  # of the half seconds of a scene, the least that has to move
LAGS = (-2, -1, 0, 1, 2)
EVERY = 6  # frames between two that are compared
WON_SHARE = 0.9  # of the compared frames, the least in which the same index wins
MARGIN_DB = 0.5  # by which it has to win on average


@dataclass(frozen=True)
class Liveliness:
    """How much a scene moves and shows: mean absolute change per half second and mean absolute second difference, in code values."""

    changes: tuple[float, ...]
    detail: float

    def objection(self) -> str | None:
        """Why the scene is not worth keeping, or None."""
        if self.detail < EMPTY:
            return f"it shows next to nothing (detail {self.detail:.2f} code values)"
        moving = sum(change >= STILL for change in self.changes) / len(self.changes)
        return None if moving >= MOVING_SHARE else f"it stands still: only {moving:.0%} of its half seconds move"


def liveliness(clip: Path, fps: int) -> Liveliness:
    """Measure a clip; raises InputError for one of less than two frames."""
    changes: list[float] = []
    detail: list[float] = []
    last: NDArray[np.int16] | None = None
    for frame in read_frames(clip):
        luma = frame.y.astype(np.int16)
        if last is not None:
            changes.append(float(np.abs(luma - last).mean()))
        detail.append(float(np.abs(np.diff(luma, 2, 1)).mean()))
        last = luma
    if not changes:
        raise InputError(f"{clip} has less than two frames")
    half = max(1, fps // 2)
    windows = [changes[i : i + half] for i in range(0, max(1, len(changes) - half // 2), half)]
    return Liveliness(tuple(float(np.mean(window)) for window in windows), float(np.mean(detail)))


@dataclass(frozen=True)
class Alignment:
    """PSNR-Y in dB of the reference brought to the other size, against that size's frames `LAGS` later, averaged over frames.

    `won` is the share of compared frames in which lag 0 is best, `margin_db` its mean lead over the best other lag.
    """

    frames: int
    compared: int
    psnr_db: tuple[float, ...]
    won: float
    margin_db: float

    def objection(self) -> str | None:
        """Why the two are not the same frames, or None."""
        if not self.compared:
            return "no frame of it moves, so that nothing says which frame is which"
        if self.won < WON_SHARE:
            return f"the same index wins in only {self.won:.0%} of the frames"
        return None if self.margin_db >= MARGIN_DB else f"the same index wins by only {self.margin_db:.2f} dB"


def alignment(reference: Path, other: Path, world: tuple[float, float, float, float]) -> Alignment:
    """Compare two renders of a scene where no HUD lies (`world`: left, top, right, bottom in 0..1), the larger one averaged down.

    Frames that hardly differ from their neighbours say nothing and are left out. Raises InputError where the sizes are no
    multiple of each other, or one clip has other frames than the other.
    """
    window: list[tuple[Plane, Plane]] = []  # five frames of both, at the smaller size
    rows: list[list[float]] = []
    frames = 0
    for pair in _pairs(reference, other, world):
        window = [*window[-4:], pair]
        frames += 1
        if len(window) == len(LAGS) and frames % EVERY == 0 and _moves([low for _, low in window]):
            rows.append([_psnr_db(window[2][0], window[2 + lag][1]) for lag in LAGS])
    if not rows:
        return Alignment(frames, 0, (), 0.0, 0.0)
    scores = np.array(rows)
    lead = scores[:, 2] - np.delete(scores, 2, axis=1).max(axis=1)
    return Alignment(frames, len(rows), tuple(scores.mean(axis=0).tolist()), float((lead > 0).mean()), float(lead.mean()))


def _pairs(reference: Path, other: Path, world: tuple[float, float, float, float]) -> Iterator[tuple[Plane, Plane]]:
    for index, (high, low) in enumerate(zip_longest(read_frames(reference), read_frames(other))):
        if high is None or low is None:
            raise InputError(f"{reference if high is None else other} ends at frame {index}, the other does not")
        scale, rest = divmod(high.height, low.height)
        if rest or high.width != low.width * scale:
            raise InputError(f"{reference} is no multiple of {other} in size")
        rows, columns = slice(*_inside(low.height, world[1::2])), slice(*_inside(low.width, world[::2]))
        mean = high.y.reshape(low.height, scale, low.width, scale).mean(axis=(1, 3))[rows, columns]
        yield np.rint(mean).astype(np.uint8), low.y[rows, columns].copy()


def _inside(length: int, sides: tuple[float, ...]) -> tuple[int, int]:
    return round(length * sides[0]), round(length * sides[1])


def _moves(planes: list[Plane]) -> bool:
    middle = planes[2].astype(np.int16)
    return all(np.abs(plane - middle).mean() >= STILL for plane in (planes[1], planes[3]))


def _psnr_db(a: Plane, b: Plane) -> float:
    error = float(np.square(a.astype(np.int16) - b, dtype=np.int32).mean())
    return psnr_db(error) if error else math.inf
