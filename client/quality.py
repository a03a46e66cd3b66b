"""The only definitions of picture quality in this product: PSNR, SSIM, temporal error; VMAF is measured in `client.vmaf`."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from client.errors import InputError
from client.frames import ColourTags, Frame, Plane
from client.vmaf import THREADS, VmafRun, why_unavailable

PEAK = 255
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = (0.01 * PEAK) ** 2
SSIM_C2 = (0.03 * PEAK) ** 2
_BLOCK = 16  # rows and columns filtered by one small matrix product; a strip of four 1080p images stays in the cache

Image = NDArray[np.float64]


@dataclass(frozen=True)
class Quality:
    """What a clip lost against its reference; a figure that is not defined is None, and `undefined` says why.

    PSNR in dB, greater is better; SSIM in -1..1, 1 is identical; temporal error in code values, 0 is best; VMAF in 0..100.
    """

    frames: int
    psnr_y_db: float | None = None
    psnr_u_db: float | None = None
    psnr_v_db: float | None = None
    ssim_y: float | None = None
    temporal_error: float | None = None
    vmaf: float | None = None
    vmaf_harmonic_mean: float | None = None
    vmaf_p5: float | None = None
    vmaf_neg: float | None = None
    vmaf_neg_harmonic_mean: float | None = None
    vmaf_neg_p5: float | None = None
    undefined: dict[str, str] = field(default_factory=dict)

    def record(self) -> dict[str, object]:
        """Every figure by name, ready for JSON: undefined ones are null, never NaN or infinity."""
        return asdict(self)


def squared_error(reference: Plane, distorted: Plane) -> int:
    """The sum of squared differences of two uint8 planes, exact; raises ValueError where they are not, or not of one shape."""
    _check_alike(reference, distorted)
    return _energy(_difference(reference, distorted))


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB of 8-bit code values, 10 log10(255^2 / MSE); MSE must be above 0 (ValueError)."""
    if mean_squared_error <= 0:
        raise ValueError("identical pictures have no PSNR")
    return 10 * math.log10(PEAK * PEAK / mean_squared_error)


def ssim(reference: Plane, distorted: Plane) -> float:
    """Structural similarity of two uint8 (H, W) planes in -1..1, averaged over the pixels whose whole window lies inside.

    Gaussian window 11x11 with sigma 1.5 and weights of sum 1, K1 = 0.01, K2 = 0.03, L = 255, population (co)variance, no
    downsampling; the map is (H - 10, W - 10). Raises ValueError where either side is below 11, and where the planes are not uint8 or
    not of one shape. Z. Wang, A. C. Bovik,
    H. R. Sheikh, E. P. Simoncelli, "Image quality assessment: from error visibility to structural similarity",
    IEEE Trans. Image Processing 13(4), 2004.
    """
    _check_alike(reference, distorted)
    height, width = reference.shape
    if min(height, width) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs {SSIM_WINDOW}x{SSIM_WINDOW} pixels, not {width}x{height}")
    total = 0.0
    for top in range(0, height - SSIM_WINDOW + 1, _BLOCK):
        strip = slice(top, top + _BLOCK + SSIM_WINDOW - 1)
        for moments in _windowed(_sums_and_squares(reference[strip], distorted[strip])):
            total += _ssim_total(moments)
    windows: int = (height - SSIM_WINDOW + 1) * (width - SSIM_WINDOW + 1)
    return total / windows


def _check_alike(reference: Plane, distorted: Plane) -> None:
    if reference.shape != distorted.shape or not reference.dtype == distorted.dtype == np.uint8:
        told = ", ".join(f"{plane.dtype} {plane.shape}" for plane in (reference, distorted))
        raise ValueError(f"only uint8 planes of one shape are compared, not {told}")


def _sums_and_squares(x: Plane, y: Plane) -> Image:
    """s, d, s^2, d^2 with s = x + y and d = x - y: four images to filter where x, y, x^2, y^2, xy are five."""
    images = np.empty((4, *x.shape))
    np.add(x, y, out=images[0], dtype=np.float64)
    np.subtract(x, y, out=images[1], dtype=np.float64)
    np.square(images[:2], out=images[2:])
    return images


def _windowed(images: Image) -> Iterator[Image]:
    """Weighted means over every whole window, as blocks of columns: products with banded matrices, which BLAS does fastest."""
    reach = SSIM_WINDOW - 1
    rows = _band(images.shape[1] - reach) @ images
    channels, height, width = rows.shape
    whole = (width - reach) // _BLOCK
    if whole:
        step, row, column = rows.strides
        blocks = as_strided(rows, (channels, whole, height, _BLOCK + reach), (step, _BLOCK * column, row, column), writeable=False)
        yield blocks @ _band(_BLOCK).T
    if width - reach > whole * _BLOCK:
        rest = rows[:, :, whole * _BLOCK :]
        yield rest @ _band(rest.shape[2] - reach).T


@functools.cache
def _band(count: int) -> Image:
    """(count, count + 10): row i holds the Gaussian from column i on."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    matrix = np.zeros((count, count + SSIM_WINDOW - 1))
    for row in range(count):
        matrix[row, row : row + SSIM_WINDOW] = weights / weights.sum()
    return matrix


def _ssim_total(moments: Image) -> float:
    s, d, ss, dd = moments
    s2, d2 = s * s, d * d
    vs, vd = ss - s2, dd - d2
    # 4 mx my = s2 - d2, 2 (mx^2 + my^2) = s2 + d2, and so for the variances; the common factor of 2 moves into C1 and C2.
    similarity = (s2 - d2 + 2 * SSIM_C1) * (vs - vd + 2 * SSIM_C2) / ((s2 + d2 + 2 * SSIM_C1) * (vs + vd + 2 * SSIM_C2))
    return float(similarity.sum())


def may_be_of_one_coding(one: ColourTags, other: ColourTags) -> bool:
    """Whether equal codes may be equal colours: range and matrix are the same, or one of the two does not say."""
    ranges, matrices = {one.range, other.range}, {one.matrix, other.matrix}
    return (0 in ranges or len(ranges) == 1) and (2 in matrices or len(matrices) == 1)


class QualityMeter:
    """Measures a clip against its reference while both stream by; a context manager, since VMAF runs in a process of its own.

    Holds one frame's luma difference, never the clip. Width and height are those of every frame, odd ones included. VMAF
    is left out with its reason where it is not wanted or not installed.
    """

    def __init__(self, width: int, height: int, *, vmaf: bool = True, vmaf_threads: int = THREADS) -> None:
        self._size = (width, height)
        self._frames = 0
        self._squared = [0, 0, 0]
        self._ssim = 0.0
        self._change_squared = 0
        self._last_difference: NDArray[np.int16] | None = None
        self._no_vmaf = why_unavailable(width, height) if vmaf else "VMAF was not asked for"
        self._vmaf = VmafRun(width, height, threads=vmaf_threads) if self._no_vmaf is None else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._vmaf is not None:
            self._vmaf.close()

    def add(self, reference: Frame, distorted: Frame) -> None:
        """Measure one pair of frames; nothing of them is kept.

        Raises InputError where a size is not the meter's or where both colour tags are known and differ (equal codes would
        be different colours), GamesrError where VMAF's process died.
        """
        self._check(reference, distorted)
        if self._vmaf is not None:
            self._vmaf.add(reference, distorted)
        difference = _difference(reference.y, distorted.y)
        self._squared[0] += _energy(difference)
        self._squared[1] += squared_error(reference.u, distorted.u)
        self._squared[2] += squared_error(reference.v, distorted.v)
        if min(self._size) >= SSIM_WINDOW:
            self._ssim += ssim(reference.y, distorted.y)
        if self._last_difference is not None:
            # (d_t - d_t-1) - (r_t - r_t-1) is the change of the error: one picture to keep where the definition names four.
            self._change_squared += _energy(difference - self._last_difference)
        self._last_difference = difference
        self._frames += 1

    def result(self) -> Quality:
        """The clip's figures; ends the measurement. Raises GamesrError where VMAF's process failed.

        PSNR is that of the clip's mean MSE over frames, on 8-bit codes without a crop; SSIM-Y the mean over frames;
        temporal error the RMS, over all luma pixels and pairs of successive frames, of the difference between the clip's
        and the reference's frame differences, in code values.
        """
        if self._frames == 0:
            return Quality(0, undefined=dict.fromkeys(_FIGURES, "no frames were measured"))
        width, height = self._size
        luma, chroma = width * height, -(-width // 2) * -(-height // 2)
        found: dict[str, float] = {}
        undefined: dict[str, str] = {}
        for name, squared, samples in zip("yuv", self._squared, (luma, chroma, chroma), strict=True):
            if squared:
                found[f"psnr_{name}_db"] = psnr_db(squared / (samples * self._frames))
            else:
                undefined[f"psnr_{name}_db"] = "identical"
        if min(self._size) >= SSIM_WINDOW:
            found["ssim_y"] = self._ssim / self._frames
        else:
            undefined["ssim_y"] = f"SSIM needs pictures of at least {SSIM_WINDOW}x{SSIM_WINDOW}, not {width}x{height}"
        if self._frames > 1:
            found["temporal_error"] = math.sqrt(self._change_squared / (luma * (self._frames - 1)))
        else:
            undefined["temporal_error"] = "one frame has no frame difference"
        if self._vmaf is not None:
            for name, scores in self._vmaf.finish().items():
                found |= {name: scores.mean, f"{name}_harmonic_mean": scores.harmonic_mean, f"{name}_p5": scores.p5}
        else:
            undefined |= {name: str(self._no_vmaf) for name in _FIGURES if name.startswith("vmaf")}
        return Quality(self._frames, **found, undefined=undefined)

    def _check(self, reference: Frame, distorted: Frame) -> None:
        width, height = self._size
        for what, frame in (("reference", reference), ("measured", distorted)):
            if (frame.width, frame.height) != self._size:
                size = f"{frame.width}x{frame.height}"
                raise InputError(f"frame {self._frames} of the {what} clip is {size} where {width}x{height} is compared")
        ours, theirs = distorted.colour, reference.colour
        if not may_be_of_one_coding(ours, theirs):
            raise InputError(
                f"the clips are not of one colour coding (measured: range {ours.range}, matrix {ours.matrix}; "
                f"reference: range {theirs.range}, matrix {theirs.matrix}): convert the reference first"
            )


_FIGURES = tuple(name for name in Quality.__dataclass_fields__ if name not in ("frames", "undefined"))


def _difference(reference: Plane, distorted: Plane) -> NDArray[np.int16]:
    return np.subtract(reference, distorted, dtype=np.int16)


def _energy(difference: NDArray[np.int16]) -> int:
    """The sum of squares, exact; the values lie within +-510, so a square needs 32 bits and a picture of them 64."""
    return int(np.square(difference, dtype=np.int32).sum(dtype=np.int64))
