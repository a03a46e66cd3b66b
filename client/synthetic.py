"""A clip that is made on the spot and the same everywhere: something to decode where no game is at hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from client.cloud import CloudEncoder, CloudSettings
from client.frames import Frame, Plane

FPS = 60
BITS_PER_PIXEL = 0.15
_SEED = 2004
_MOST_STEPS = 256  # a larger wall for more frames would need memory by their square


def write_synthetic_clip(path: Path, width: int, height: int, frames: int) -> None:
    """Write `frames` synthetic frames as raw low-latency H.264 (Annex B) at 0.15 bits per pixel; width and height are even."""
    settings = CloudSettings(bitrate_kbps=round(BITS_PER_PIXEL * width * height * FPS / 1000), fps=FPS)
    encoder = CloudEncoder(settings, width, height)
    with path.open("wb") as file:
        for frame in synthetic_frames(width, height, frames):
            file.writelines(encoder.encode(frame))
        file.writelines(encoder.flush())


def synthetic_frames(width: int, height: int, frames: int) -> Iterator[Frame]:
    """A textured wall that scrolls by 3 and 1 pixels a frame behind a still frame of flat colour, as a camera turn under a HUD.

    The wall is as large as its first 256 steps need; with more of them it comes round again.
    """
    rng = np.random.default_rng(_SEED)
    steps = min(frames, _MOST_STEPS)
    tall, wide = height + steps, width + 3 * steps
    wall = np.zeros((tall, wide), np.uint16)
    for cell in (2, 4, 16, 64):
        wall += _noise(rng, tall, wide, cell)
    tint = [_noise(rng, tall // 2 + 1, wide // 2 + 1, 32) // 4 + 96 for _ in range(2)]
    planes = [plane.astype(np.uint8) for plane in (wall // 4, *tint)]
    for index in range(frames):
        row, column = index, 3 * index
        y = _window(planes[0], row, column, height, width)
        y[-height // 8 :, : width // 4] = 200
        u, v = (_window(plane, row // 2, column // 2, height // 2, width // 2) for plane in planes[1:])
        yield Frame(y, u, v)


def _window(plane: Plane, row: int, column: int, height: int, width: int) -> Plane:
    """A copy of a part of a plane whose last row lies above its first, and whose last column beside its first."""
    rows = plane.take(np.arange(row, row + height), 0, mode="wrap")
    return rows.take(np.arange(column, column + width), 1, mode="wrap")


def _noise(rng: np.random.Generator, height: int, width: int, cell: int) -> np.ndarray:
    """White noise in squares of `cell` pixels, 16..235."""
    cells = rng.integers(16, 236, (-(-height // cell), -(-width // cell))).astype(np.uint16)
    return cells.repeat(cell, 0).repeat(cell, 1)[:height, :width]
