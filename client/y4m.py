"""Uncompressed 4:2:0 pictures as ffmpeg, mpv and VapourSynth read and write them (YUV4MPEG2)."""

from __future__ import annotations

from fractions import Fraction
from typing import BinaryIO

from client.frames import Frame

FULL_RANGE = 2  # AVColorRange
_DIGITS = 7
_GREATEST = 10**_DIGITS - 1


class Y4mWriter:
    """Writes pictures of one size, one after the other; 4:2:0 as MPEG-2 and H.264 site it.

    The header is of one length whatever the rate, so that `header` can be written again at the end. Raises OSError.
    """

    def __init__(self, file: BinaryIO, first: Frame, rate: Fraction, *, sample_aspect_ratio: Fraction = Fraction(1)) -> None:
        self._file = file
        self._size = first.width, first.height
        self._aspect = sample_aspect_ratio
        self._full = first.colour.range == FULL_RANGE
        self.header(rate)

    def header(self, rate: Fraction) -> None:
        width, height = self._size
        rate = max(rate, Fraction(1, 1000)).limit_denominator(1001)
        if rate.numerator > _GREATEST:
            rate = Fraction(min(round(rate), _GREATEST))
        numbers = f"F{rate.numerator:0{_DIGITS}}:{rate.denominator:0{_DIGITS}} Ip A{self._aspect.numerator}:{self._aspect.denominator}"
        colours = f"C420mpeg2 XCOLORRANGE={'FULL' if self._full else 'LIMITED'}"
        self._all(f"YUV4MPEG2 W{width} H{height} {numbers} {colours}\n".encode())

    def picture(self, frame: Frame) -> None:
        """Write one; it has the size of the first."""
        self._all(b"FRAME\n")
        for plane in (frame.y, frame.u, frame.v):
            self._all(plane.data if plane.flags.c_contiguous else plane.tobytes())

    def _all(self, data: bytes | memoryview) -> None:
        view = memoryview(data).cast("B")
        while view:  # an unbuffered file may take a part
            view = view[self._file.write(view) :]
