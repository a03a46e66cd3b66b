"""Chroma planes of 4:4:4, 4:2:2 and NV12 as left-sited 4:2:0, the way H.264 places them."""

from __future__ import annotations

import numpy as np

from client.frames import Plane


def halve_rows(plane: Plane) -> Plane:
    """Mean of each pair of rows, halves rounded up: uint8 (H, W) to uint8 (ceil(H/2), W); an odd last row pairs with itself."""
    total = _pair_sums(plane)
    return ((total + 1) >> 1).astype(np.uint8)


def halve_rows_and_columns(plane: Plane) -> Plane:
    """Uint8 (H, W) to uint8 (ceil(H/2), ceil(W/2)): [1 2 1]/4 about each even column, then the mean of each pair of rows.

    The even columns are where left-sited 4:2:0 has its samples, so nothing moves. Edges are replicated; one rounding.
    """
    rows = _pair_sums(plane)
    centre = rows[:, 0::2]
    left = np.concatenate((rows[:, :1], rows[:, 1:-1:2]), axis=1)
    right = rows[:, 1::2]
    if right.shape[1] < centre.shape[1]:  # an odd width: the last column is its own right neighbour
        right = np.concatenate((right, rows[:, -1:]), axis=1)
    return ((left + 2 * centre + right + 4) >> 3).astype(np.uint8)


def _pair_sums(plane: Plane) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    upper = plane[0::2].astype(np.uint16)
    lower = plane[1::2]
    upper[: lower.shape[0]] += lower
    if lower.shape[0] < upper.shape[0]:
        upper[-1] *= 2
    return upper
