"""A decoded frame: the planes of 8-bit 4:2:0 and what belongs to them."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ColourTags:
    """How code values become colours, as ITU-T H.273 code points; `range` is 1 for limited, 2 for full, 0 for unknown."""

    range: int = 0
    primaries: int = 2
    transfer: int = 2
    matrix: int = 2


BT709_LIMITED = ColourTags(range=1, primaries=1, transfer=1, matrix=1)


@dataclass(frozen=True, slots=True)
class Frame:
    """Planes of 8-bit 4:2:0, time and colour tags.

    `y` is uint8 (H, W); `u` and `v` are uint8 (ceil(H/2), ceil(W/2)), left-sited. Rows may lie further apart than they
    are long (a decoder's stride). `damaged` says that the frame was decoded from a broken packet or may refer to one that
    was: damage lasts until the next key frame. Raises ValueError for planes of another type or of other sizes: what is computed from
    them would look like a picture.
    """

    y: Plane
    u: Plane
    v: Plane
    pts: int | None = None
    time_base: Fraction | None = None
    colour: ColourTags = BT709_LIMITED
    damaged: bool = False

    def __post_init__(self) -> None:
        shapes = self.y.shape, self.u.shape, self.v.shape
        if any(plane.dtype != np.uint8 for plane in (self.y, self.u, self.v)):
            types = ", ".join(str(plane.dtype) for plane in (self.y, self.u, self.v))
            raise ValueError(f"planes are uint8 code values, not {types}")
        if len(shapes[0]) != 2 or not all(shapes[0]) or shapes != plane_shapes(*shapes[0]):
            raise ValueError(f"planes of {', '.join(map(str, shapes))} are not a picture in 4:2:0")

    @property
    def height(self) -> int:
        return int(self.y.shape[0])

    @property
    def width(self) -> int:
        return int(self.y.shape[1])


def plane_shapes(height: int, width: int) -> tuple[tuple[int, int], tuple[int, int], tuple[int, int]]:
    """Rows and columns of y, u and v in 4:2:0."""
    chroma = (-(-height // 2), -(-width // 2))
    return (height, width), chroma, chroma
