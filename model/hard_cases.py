"""Pictures that are hard on a recurrent network, made on the spot: each function gives `length` frames, the same every time.

All of them take width and height in luma pixels, both even unless said, and the number of frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from client.cloud import CloudSettings, through_codec
from client.frames import BT709_LIMITED, ColourTags, Frame, Plane
from client.lettering import ADVANCE, HEIGHT, letters
from client.synthetic import FPS, synthetic_frames

BLACK, WHITE, NEUTRAL = 16, 235, 128
FULL_RANGE = ColourTags(range=2, primaries=1, transfer=1, matrix=1)
CUT_EVERY = 8
# Y, U, V of red, green, blue, cyan, magenta and yellow in BT.709 limited range, then two corners of the code space, which are no colours
SATURATED = ((63, 102, 240), (173, 42, 26), (32, 240, 118), (188, 154, 16), (78, 214, 230), (219, 16, 138), (128, 0, 255), (128, 255, 0))
_SEED = 2024


def black(width: int, height: int, length: int) -> Iterator[Frame]:
    yield from repeat(_grey(np.full((height, width), BLACK)), length)


def white(width: int, height: int, length: int) -> Iterator[Frame]:
    yield from repeat(_grey(np.full((height, width), WHITE)), length)


def saturated(width: int, height: int, length: int) -> Iterator[Frame]:
    """Bars, 8 pixels wide, of the most saturated colours and of codes beyond them, that move right by 2 pixels a frame."""
    bars = np.array(SATURATED).repeat(4, axis=0)  # of chroma samples
    for t in range(length):
        y, u, v = bars[(np.arange(width // 2) - t) % len(bars)].T
        yield _frame(np.tile(y.repeat(2), (height, 1)), np.tile(u, (height // 2, 1)), np.tile(v, (height // 2, 1)))


def checkerboard(width: int, height: int, length: int) -> Iterator[Frame]:
    """Black and white in turn from pixel to pixel and from frame to frame: the Nyquist limit of rows, columns and time."""
    rows, columns = np.mgrid[:height, :width]
    for t in range(length):
        yield _grey(np.where((rows + columns + t) % 2, WHITE, BLACK))


def lines(width: int, height: int, length: int) -> Iterator[Frame]:
    """Lines one pixel wide, upright, level and oblique, every 12 pixels; each moves by one pixel a frame."""
    rows, columns = np.mgrid[:height, :width]
    for t in range(length):
        lit = ((columns - t) % 12 == 0) | ((rows - t) % 12 == 0) | ((rows + columns + t) % 12 == 0)
        yield _grey(np.where(lit, WHITE, BLACK))


def text(width: int, height: int, length: int) -> Iterator[Frame]:
    """Small letters over the whole picture that scroll up by one pixel a frame."""
    pitch = HEIGHT + 2
    alphabet = "".join(chr(code) for code in range(33, 127))
    count = width // ADVANCE + 1
    page = np.concatenate([_mask(alphabet[row:] + alphabet[:row], count, width) for row in range(0, 5 * (height // pitch + 2), 5)])
    for t in range(length):
        yield _grey(np.where(np.roll(page, -t, axis=0)[:height], WHITE, BLACK + 24))


def noise(width: int, height: int, length: int) -> Iterator[Frame]:
    """White noise over all codes in all planes, new in every frame; of any size."""
    rng = np.random.default_rng(_SEED)
    chroma = (-(-height // 2), -(-width // 2))
    for _ in range(length):
        yield _frame(*(rng.integers(0, 256, shape) for shape in ((height, width), chroma, chroma)))


def grain(width: int, height: int, length: int) -> Iterator[Frame]:
    """A still picture under Gaussian grain, sigma 8 code values in luma and 3 in chroma, new in every frame."""
    rng = np.random.default_rng(_SEED)
    base = _texture(width, height)
    for _ in range(length):
        yield _frame(*(plane + rng.normal(0, sigma, plane.shape) for plane, sigma in ((base.y, 8), (base.u, 3), (base.v, 3))))


def flashes(width: int, height: int, length: int) -> Iterator[Frame]:
    """Black, white, black, white: a flash in every other frame."""
    pair = next(black(width, height, 1)), next(white(width, height, 1))
    for t in range(length):
        yield pair[t % 2]


def fade(width: int, height: int, length: int) -> Iterator[Frame]:
    """A picture that goes to black over the whole length: no sample ever moves away from black."""
    base = _texture(width, height)
    for t in range(length):
        level = 1 - t / max(1, length - 1)
        yield _frame(*(dark + level * (plane - float(dark)) for plane, dark in ((base.y, BLACK), (base.u, NEUTRAL), (base.v, NEUTRAL))))


def cuts(width: int, height: int, length: int) -> Iterator[Frame]:
    """Another scene every 8 frames, with nothing in common with the one before."""
    rng = np.random.default_rng(_SEED)
    for t in range(length):
        if t % CUT_EVERY == 0:
            sizes = ((height, width), (height // 2, width // 2), (height // 2, width // 2))
            scene = _frame(*(_patches(rng, *size, cell) for size, cell in zip(sizes, (6, 3, 3), strict=True)))
        yield scene


def hud(width: int, height: int, length: int) -> Iterator[Frame]:
    """A textured wall that moves behind a still panel and still letters, but for a counter of frames."""
    for t, frame in enumerate(there_and_back(list(synthetic_frames(width, height, min(length, FPS))), length)):
        y = frame.y.copy()
        for row, said in ((2, "HEALTH 100"), (2 + 2 * HEIGHT, f"AMMO {t % 1000:3}")):
            dots = letters(said, 1)[: max(0, height - row), : width - 2]
            y[row : row + dots.shape[0], 2 : 2 + dots.shape[1]] = np.where(dots, WHITE, BLACK)
        yield replace(frame, y=y)


def limited_range(width: int, height: int, length: int) -> Iterator[Frame]:
    """Every code of limited range in every plane, as ramps that move; where a ramp begins anew, black meets white."""
    return _ramps(width, height, length, (BLACK, WHITE), (16, 240), BT709_LIMITED)


def full_range(width: int, height: int, length: int) -> Iterator[Frame]:
    """The same over all codes, 0 and 255 included, beyond which an overshoot must be clamped and not wrapped."""
    return _ramps(width, height, length, (0, 255), (0, 255), FULL_RANGE)


def blocking(frames: Sequence[Frame], bits_per_pixel: float) -> list[Frame]:
    """The frames as x264 leaves them at so few bits, at 60 frames/s: blocks, skipped motion, a fresh picture every second."""
    pixels_per_s = frames[0].width * frames[0].height * FPS
    return list(through_codec(frames, CloudSettings(bitrate_kbps=max(1, round(bits_per_pixel * pixels_per_s / 1000)), fps=FPS)))


def there_and_back(frames: Sequence[Frame], length: int) -> Iterator[Frame]:
    """A clip played forwards, backwards and so on for `length` frames: motion without a cut, for as long as one likes."""
    order = list(range(len(frames))) + list(range(len(frames) - 2, 0, -1))
    for step in range(length):
        yield frames[order[step % len(order)]]


def _frame(y: NDArray[np.generic], u: NDArray[np.generic], v: NDArray[np.generic], *, colour: ColourTags = BT709_LIMITED) -> Frame:
    """Code values of any dtype as a frame: rounded, and clamped to 0..255."""
    luma, blue, red = (np.rint(plane).clip(0, 255).astype(np.uint8) for plane in (y, u, v))
    return Frame(luma, blue, red, colour=colour)


def _grey(y: NDArray[np.generic]) -> Frame:
    chroma = np.full((y.shape[0] // 2, y.shape[1] // 2), NEUTRAL)
    return _frame(y, chroma, chroma)


def _texture(width: int, height: int) -> Frame:
    return next(synthetic_frames(width, height, 1))


def _mask(line: str, count: int, width: int) -> NDArray[np.bool_]:
    dots = letters((line * (count // len(line) + 1))[:count], 1)[:, :width]
    return np.pad(dots, ((0, 2), (0, 0)))


def _patches(rng: np.random.Generator, height: int, width: int, cell: int) -> Plane:
    """Squares of one code each, in a contrast and a brightness of the scene's own."""
    low, high = sorted(rng.integers(0, 256, 2))
    cells = rng.integers(low, high + 1, (-(-height // cell), -(-width // cell)))
    patches: Plane = cells.repeat(cell, 0).repeat(cell, 1)[:height, :width].astype(np.uint8)
    return patches


def _ramps(width: int, height: int, length: int, luma: tuple[int, int], chroma: tuple[int, int], colour: ColourTags) -> Iterator[Frame]:
    def ramp(low: int, high: int, places: NDArray[np.integer]) -> NDArray[np.integer]:
        return low + places % (high - low + 1)

    rows, columns = np.mgrid[:height, :width]
    chroma_rows, chroma_columns = rows[: height // 2, : width // 2], columns[: height // 2, : width // 2]
    for t in range(length):
        # 3 codes a pixel in luma, 5 in chroma, and one a row between them: every code comes by in a small picture too
        y = ramp(*luma, 3 * columns + rows + 6 * t)
        u, v = ramp(*chroma, 5 * chroma_columns + chroma_rows + 6 * t), ramp(*chroma, 5 * chroma_rows + chroma_columns + 6 * t)
        yield _frame(y, u, v, colour=colour)
