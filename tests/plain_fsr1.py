"""FSR 1 as its shaders are described: one output pixel after another, in plain Python numbers, for tiny pictures."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Rgb = NDArray[np.float64]


def easu(picture: Rgb, scale: int) -> Rgb:
    """(H, W, 3) in [0, 1] to (scale*H, scale*W, 3)."""
    height, width, _ = picture.shape
    found = np.empty((scale * height, scale * width, 3))
    for row in range(scale * height):
        for column in range(scale * width):
            found[row, column] = _easu_pixel(picture, (row + 0.5) / scale - 0.5, (column + 0.5) / scale - 0.5)
    return found


def _easu_pixel(picture: Rgb, y: float, x: float) -> Rgb:
    top, left = math.floor(y), math.floor(x)
    py, px = y - top, x - left

    def colour(row: int, column: int) -> Rgb:
        height, width, _ = picture.shape
        found: Rgb = picture[min(max(top + row, 0), height - 1), min(max(left + column, 0), width - 1)]
        return found

    def luma(row: int, column: int) -> float:
        red, green, blue = colour(row, column)
        return float(0.5 * red + green + 0.5 * blue)

    direction_x = direction_y = length = 0.0
    for row, column, weight in ((0, 0, (1 - px) * (1 - py)), (0, 1, px * (1 - py)), (1, 0, (1 - px) * py), (1, 1, px * py)):
        c = luma(row, column)
        left_of, right_of = luma(row, column - 1), luma(row, column + 1)
        above, below = luma(row - 1, column), luma(row + 1, column)
        direction_x += weight * (right_of - left_of)
        direction_y += weight * (below - above)
        length += weight * _edge(left_of, c, right_of) ** 2
        length += weight * _edge(above, c, below) ** 2
    squared = direction_x**2 + direction_y**2
    if squared < 1 / 32768:
        direction_x = 1.0
    else:
        direction_x, direction_y = direction_x / math.sqrt(squared), direction_y / math.sqrt(squared)
    length = (length / 2) ** 2
    stretch = (direction_x**2 + direction_y**2) / max(abs(direction_x), abs(direction_y))
    length_x, length_y = 1 + (stretch - 1) * length, 1 - 0.5 * length
    lobe = 0.5 + (1 / 4 - 0.04 - 0.5) * length
    clip = 1 / lobe

    total, weights = np.zeros(3), 0.0
    for row, column in ((-1, 0), (-1, 1), (0, -1), (0, 0), (0, 1), (0, 2), (1, -1), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1)):
        off_x, off_y = column - px, row - py
        v_x = (off_x * direction_x + off_y * direction_y) * length_x
        v_y = (off_x * -direction_y + off_y * direction_x) * length_y
        d2 = min(v_x**2 + v_y**2, clip)
        base = 25 / 16 * (2 / 5 * d2 - 1) ** 2 - (25 / 16 - 1)
        window = (lobe * d2 - 1) ** 2
        total += colour(row, column) * base * window
        weights += base * window
    nearest = [colour(0, 0), colour(0, 1), colour(1, 0), colour(1, 1)]
    return np.clip(total / weights, np.min(nearest, axis=0), np.max(nearest, axis=0))


def _edge(before: float, centre: float, after: float) -> float:
    steepest = max(abs(after - centre), abs(centre - before))
    return min(1.0, abs(after - before) / steepest) if steepest else 0.0


def rcas(picture: Rgb, stops: float) -> Rgb:
    """(H, W, 3) in [0, 1], sharpened."""
    height, width, _ = picture.shape
    found = np.empty_like(picture)
    for row in range(height):
        for column in range(width):
            b, h = picture[max(row - 1, 0), column], picture[min(row + 1, height - 1), column]
            d, f = picture[row, max(column - 1, 0)], picture[row, min(column + 1, width - 1)]
            e = picture[row, column]
            lobes = []
            for channel in range(3):
                ring = [float(p[channel]) for p in (b, d, f, h)]
                least, greatest = min(ring), max(ring)
                hit_min = least / (4 * greatest) if greatest else 0.0
                hit_max = (1 - greatest) / (4 * least - 4) if least < 1 else 0.0
                lobes.append(max(-hit_min, hit_max))
            lobe = max(-(0.25 - 1 / 16), min(max(lobes), 0.0)) * 2**-stops
            found[row, column] = (lobe * (b + d + f + h) + e) / (4 * lobe + 1)
    return found
