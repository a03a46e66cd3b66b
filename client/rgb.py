"""A frame's planes as RGB, for pictures that people look at."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from numpy.typing import NDArray

from client.frames import ColourTags, Frame, Plane

RgbPicture = NDArray[np.uint8]

_KR_KB = {5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}  # H.273 matrix code points; all others are read as BT.709
_BT709 = (0.2126, 0.0722)


def to_rgb(frame: Frame) -> RgbPicture:
    """A frame as R'G'B', uint8 (H, W, 3), rounded and clamped once, in the transfer that the planes are in.

    Matrix and range are those of the colour tags: BT.601, BT.2020 or else BT.709, and full or else limited range. Chroma
    is raised bilinearly from its left-sited position, edges replicated. ITU-T H.273 (equations 38 to 44).
    """
    y, c, black = _scales(frame.colour)
    kr, kb = _KR_KB.get(frame.colour.matrix, _BT709)
    kg = 1 - kr - kb
    luma = (frame.y.astype(np.float32) - black) * y
    cb, cr = ((_raise_chroma(plane, frame.height, frame.width) - 128) * c for plane in (frame.u, frame.v))
    red, blue = luma + 2 * (1 - kr) * cr, luma + 2 * (1 - kb) * cb
    green = luma - 2 * (1 - kb) * kb / kg * cb - 2 * (1 - kr) * kr / kg * cr
    picture: RgbPicture = np.clip(np.rint(np.stack((red, green, blue), axis=-1)), 0, 255).astype(np.uint8)
    return picture


def to_png(picture: RgbPicture) -> bytes:
    """The picture as a PNG file."""
    encoder = VideoCodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt = picture.shape[1], picture.shape[0], "rgb24"
    encoder.time_base = Fraction(1)
    image = av.VideoFrame.from_ndarray(picture, format="rgb24")
    return b"".join(bytes(packet) for packet in [*encoder.encode(image), *encoder.encode(None)])


def _scales(colour: ColourTags) -> tuple[float, float, int]:
    """Factors that bring luma and chroma to a range of 255, and the code of black."""
    return (1.0, 1.0, 0) if colour.range == 2 else (255 / 219, 255 / 224, 16)


def _raise_chroma(plane: Plane, height: int, width: int) -> NDArray[np.floating]:
    """To luma's size: chroma column j lies on luma column 2j, chroma row i between luma rows 2i and 2i + 1."""
    samples = np.pad(plane.astype(np.float32), ((1, 1), (0, 1)), mode="edge")
    above, centre, below = samples[:-2], samples[1:-1], samples[2:]
    rows = np.stack((above + 3 * centre, 3 * centre + below), axis=1).reshape(-1, samples.shape[1]) / 4
    columns = np.stack((rows[:, :-1], (rows[:, :-1] + rows[:, 1:]) / 2), axis=2)
    raised: NDArray[np.floating] = columns.reshape(len(rows), -1)[:height, :width]
    return raised
