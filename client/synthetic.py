"""A clip that is made on the spot and the same everywhere: something to decode where no game is at hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from client.cloud import CloudEncoder, CloudSettings
from client.frames import Frame

FPS = 60
BITS_PER_PIXEL = 0.15
_SEED = 2004


def write_synthetic_clip(path: Path, width: int, height: int, frames: int) -> None:
    """Write `frames` synthetic frames as raw low-latency H.264 (Annex B) at 0.15 bits per pixel; width and height are even."""
    settings = CloudSettings(bitrate_kbps=round(BITS_PER_PIXEL * width * height * FPS / 1000), fps=FPS)
    encoder = CloudEncoder(settings, width, height)
    with path.open("wb") as file:
        for frame in synthetic_frames(width, height, frames):
            file.writelines(encoder.encode(frame))
        file.writelines(encoder.flush())


def synthetic_frames(width: int, height: int, frames: int) -> Iterator[Frame]:
    """A textured wall that scrolls by 3 and 1 pixels a frame behind a still frame of flat colour, as a camera turn under a HUD."""
    rng = np.random.default_rng(_SEED)
    tall, wide = height + frames, width + 3 * frames
    wall = sum(_noise(rng, tall, wide, cell) / 4 for cell in (2, 4, 16, 64))
    tint = [_noise(rng, tall // 2 + 1, wide // 2 + 1, 32) / 4 + 96 for _ in range(2)]
    planes = [np.asarray(plane).astype(np.uint8) for plane in (wall, *tint)]
    for index in range(frames):
        row, column = index, 3 * index
        y = planes[0][row : row + height, column : column + width].copy()
        y[-height // 8 :, : width // 4] = 200
        u, v = (plane[row // 2 :, column // 2 :][: height // 2, : width // 2] for plane in planes[1:])
        yield Frame(y, u, v)


def _noise(rng: np.random.Generator, height: int, width: int, cell: int) -> np.ndarray:
    """White noise in squares of `cell` pixels, 16..235."""
    cells = rng.integers(16, 236, (-(-height // cell), -(-width // cell))).astype(np.float64)
    return cells.repeat(cell, 0).repeat(cell, 1)[:height, :width]
