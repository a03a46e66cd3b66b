"""The made pictures are what they are called: of their size, the same every time, and as hard as is said."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise, product

import numpy as np
import pytest

from client.frames import Frame
from client.quality import psnr_db, squared_error
from model import hard_cases as pictures
from model.probes import same_picture

Make = Callable[[int, int, int], Iterator[Frame]]
SIZE = (32, 24)
MADE = [
    pictures.black,
    pictures.white,
    pictures.saturated,
    pictures.checkerboard,
    pictures.lines,
    pictures.text,
    pictures.noise,
    pictures.grain,
    pictures.flashes,
    pictures.fade,
    pictures.cuts,
    pictures.hud,
    pictures.limited_range,
    pictures.full_range,
]


@pytest.mark.parametrize("make", MADE)
def test_pictures_are_frames_of_their_size_and_the_same_every_time(make: Make) -> None:
    frames = list(make(*SIZE, 9))
    assert len(frames) == 9
    for frame, again in zip(frames, make(*SIZE, 9), strict=True):
        assert [(p.shape, p.dtype) for p in (frame.y, frame.u, frame.v)] == [
            ((24, 32), np.uint8),
            ((12, 16), np.uint8),
            ((12, 16), np.uint8),
        ]
        assert same_picture(frame, again)


@pytest.mark.parametrize("make", MADE)
def test_pictures_may_be_as_small_as_two_pixels(make: Make) -> None:
    for width, height in product((2, 8), range(2, 22, 2)):
        assert [frame.y.shape for frame in make(width, height, 2)] == [(height, width)] * 2


@pytest.mark.parametrize("make", [m for m in MADE if m not in (pictures.black, pictures.white, pictures.cuts)])
def test_what_is_no_still_changes_from_frame_to_frame(make: Make) -> None:
    frames = list(make(*SIZE, 9))
    assert not any(same_picture(a, b) for a, b in pairwise(frames))


def test_the_checkerboard_is_at_the_nyquist_limit_of_every_axis() -> None:
    clip = np.stack([frame.y for frame in pictures.checkerboard(*SIZE, 4)]).astype(float)
    spectrum = np.abs(np.fft.fftn(clip - clip.mean()))
    assert spectrum[2, 12, 16] == pytest.approx(spectrum.sum())


def test_a_fade_never_leaves_the_way_to_black() -> None:
    clip = [np.concatenate([(f.y - 16.0).ravel(), (f.u - 128.0).ravel(), (f.v - 128.0).ravel()]) for f in pictures.fade(*SIZE, 30)]
    assert np.ptp(clip[0]) > 50 and not clip[-1].any()
    assert all((np.abs(later) <= np.abs(earlier)).all() and (later * earlier >= 0).all() for earlier, later in pairwise(clip))


def test_flashes_alternate_and_cuts_cut() -> None:
    flashes = list(pictures.flashes(*SIZE, 4))
    assert same_picture(flashes[0], flashes[2]) and same_picture(flashes[1], flashes[3])
    assert (flashes[1].y - flashes[0].y == 219).all()
    scenes = list(pictures.cuts(*SIZE, 24))
    changes = [not same_picture(a, b) for a, b in pairwise(scenes)]
    assert [index for index, change in enumerate(changes, 1) if change] == [8, 16]


def test_ranges_are_used_up_and_text_scrolls_by_a_pixel() -> None:
    for make, luma, chroma in ((pictures.full_range, (0, 255), (0, 255)), (pictures.limited_range, (16, 235), (16, 240))):
        frames = list(make(96, 64, 16))
        assert np.array_equal(np.unique([f.y for f in frames]), np.arange(luma[0], luma[1] + 1))
        for plane in ("u", "v"):
            codes = np.unique([getattr(f, plane) for f in frames])
            assert np.array_equal(codes, np.arange(chroma[0], chroma[1] + 1))
    first, second = pictures.text(*SIZE, 2)
    assert np.array_equal(second.y[:-1], first.y[1:])


def test_a_clip_goes_there_and_back_without_a_cut() -> None:
    frames = list(pictures.noise(*SIZE, 4))
    played = list(pictures.there_and_back(frames, 9))
    assert [next(i for i, f in enumerate(frames) if f is p) for p in played] == [0, 1, 2, 3, 2, 1, 0, 1, 2]


def test_blocking_leaves_every_frame_and_little_of_it() -> None:
    frames = list(pictures.hud(96, 64, 6))
    left = pictures.blocking(frames, 0.02)
    assert len(left) == 6
    assert all(psnr_db(squared_error(a.y, b.y) / a.y.size) < 30 for a, b in zip(frames, left, strict=True))
