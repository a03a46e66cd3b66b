"""Lines of text as pixels, to be laid over a live picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from client import lettering

Pixels = NDArray[np.uint32]

_BOX, _LETTER = 0xB0000000, 0xFFFFFFFF  # ARGB: black through which the picture is seen, and white
_LINE_DOTS = lettering.HEIGHT + 3
_MARGIN_DOTS = 3


def text_box(lines: Sequence[str], width: int, height: int) -> Pixels:
    """White letters on a translucent black box, uint32 ARGB (rows, columns), for a window of `width` x `height` pixels.

    A dot of a letter is as high as a 360th of the window; lower, to one pixel, where the longest line or all lines would not fit.
    """
    columns = lettering.ADVANCE * max(len(line) for line in lines) + 2 * _MARGIN_DOTS
    rows = _LINE_DOTS * len(lines) + 2 * _MARGIN_DOTS
    dot = max(1, min(height // 360, width // columns, height // rows))
    box = np.full((rows * dot, columns * dot), _BOX, np.uint32)
    for number, line in enumerate(lines):
        letters = lettering.letters(line, dot)
        top, start = (_MARGIN_DOTS + number * _LINE_DOTS) * dot, _MARGIN_DOTS * dot
        box[top : top + letters.shape[0], start : start + letters.shape[1]][letters] = _LETTER
    return box
