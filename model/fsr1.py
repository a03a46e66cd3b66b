"""FSR 1, the upscaler that players have today: EASU enlarges along edges, RCAS sharpens what came out.

Written from the description in AMD FidelityFX Super Resolution 1.0 (GPUOpen, `ffx_fsr1.h` of 2021-06-29, MIT). Quotients and
roots are exact here where AMD's shaders approximate them. AMD means it for up to x2 in each direction; x3 goes beyond that.
"""

from __future__ import annotations

import math
from functools import reduce

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.colour import PlanesToRgb, RgbToPlanes
from model.interpolation import phase_weights

SHARPNESS_STOPS = 0.2  # below the greatest sharpness; AMD's own choice
LOBE_LIMIT = 0.25 - 1 / 16
FLAT = 1 / 32768  # of a squared gradient; below it an edge has no direction
TINY = 1e-5  # the least divisor; dividends vanish with them, so that 0 / 0 becomes 0

# The 12 input pixels of an output pixel as (row, column) from the one above and left of it: 4x4 without the corners.
TAPS = [(row, column) for row in range(-1, 3) for column in range(-1, 3) if {row, column} - {-1, 2}]


class Easu(nn.Module):
    """Edge Adaptive Spatial Upsampling: RGB (N, 3, H, W) in [0, 1] to (N, 3, scale*H, scale*W), edges replicated.

    An output pixel is a mean of 12 input pixels, weighted by a radial kernel like Lanczos's that is turned and stretched to
    the edge found there, then held between the least and the greatest of the nearest 4. At a whole scale it lies in one of
    scale^2 places between them: each of these phases is computed on the input's grid, and PixelShuffle interleaves them.
    """

    bilinear: Tensor
    offsets: Tensor

    def __init__(self, scale: int) -> None:
        super().__init__()
        self.scale = scale
        axis = phase_weights("linear", scale, 1, 0.0)[:, 0]
        bilinear = torch.einsum("iy,jx->ijyx", axis, axis).reshape(scale * scale, 1, 3, 3)
        self.register_buffer("bilinear", bilinear.repeat(3, 1, 1, 1), persistent=False)
        places = [(phase + 0.5) / scale - 0.5 for phase in range(scale)]
        self.bases = [(math.floor(y), math.floor(x)) for y in places for x in places]
        offsets = [[(row - y % 1, column - x % 1) for row, column in TAPS] for y in places for x in places]
        squares = torch.tensor([[(x * x, 2 * x * y, y * y) for y, x in taps] for taps in offsets], dtype=torch.float64)
        self.register_buffer("offsets", squares[..., None, None], persistent=False)

    def forward(self, rgb: Tensor) -> Tensor:
        padded = F.pad(rgb, (2, 2, 2, 2), mode="replicate")
        least, greatest = -F.max_pool2d(-padded, 2, 1), F.max_pool2d(padded, 2, 1)
        height, width = rgb.shape[2:]

        def moved(picture: Tensor, row: int, column: int) -> Tensor:
            return picture[:, :, 2 + row : 2 + row + height, 2 + column : 2 + column + width]

        metric, window = self._kernel(padded)
        phases = []
        for phase, (top, left) in enumerate(self.bases):
            squared_distance = F.conv2d(metric[:, phase :: len(self.bases)], self.offsets[phase].to(rgb.dtype))
            weights = _lanczos2(squared_distance, window[:, phase : phase + 1])
            taps = [moved(padded, top + row, left + column) for row, column in TAPS]
            total = sum(weight * tap for weight, tap in zip(weights.chunk(len(TAPS), 1), taps, strict=True))
            mean = total / weights.sum(1, keepdim=True)
            phases.append(mean.clamp(moved(least, top, left), moved(greatest, top, left)))
        return F.pixel_shuffle(torch.stack(phases, 2).flatten(1, 2), self.scale)

    def _kernel(self, padded: Tensor) -> tuple[Tensor, Tensor]:
        """The kernel's shape for every phase of every pixel: its metric (N, 3 * phases, H, W) and the square of its radius.

        The metric holds the factors of x^2, 2xy and y^2 in the squared distance of a tap, after the turn and the stretch.
        """
        edges = F.conv2d(_edges(padded), self.bilinear.to(padded.dtype), groups=3)
        x, y, length = edges.chunk(3, 1)
        squared = x * x + y * y
        flat = squared < FLAT
        x, squared = x.masked_fill(flat, 1.0), squared.masked_fill(flat, 1.0)
        length = (length / 2).square()
        stretch = (squared / torch.maximum(x.square(), y.square())).sqrt()  # 1 along an axis, sqrt(2) along a diagonal
        across, along = (1 + (stretch - 1) * length).square(), (1 - 0.5 * length).square()
        xx, xy, yy = x * x / squared, x * y / squared, y * y / squared
        metric = torch.cat((across * xx + along * yy, (across - along) * xy, across * yy + along * xx), 1)
        lobe = 0.5 + (0.25 - 0.04 - 0.5) * length
        return metric, 1 / lobe


def _edges(padded: Tensor) -> Tensor:
    """Gradients in x and y and a measure of edge, 0 (a line or noise) to 2, of each pixel but the outermost: (N, 3, H, W)."""
    luma = 0.5 * padded[:, :1] + padded[:, 1:2] + 0.5 * padded[:, 2:]
    centre = luma[:, :, 1:-1, 1:-1]
    x, x_edge = _gradient(luma[:, :, 1:-1, :-2], centre, luma[:, :, 1:-1, 2:])
    y, y_edge = _gradient(luma[:, :, :-2, 1:-1], centre, luma[:, :, 2:, 1:-1])
    return torch.cat((x, y, x_edge + y_edge), 1)


def _gradient(before: Tensor, centre: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """The difference across a pixel; and 1 where its two halves are one step, 0 where they cancel."""
    gradient = after - before
    steepest = torch.maximum((after - centre).abs(), (centre - before).abs())
    return gradient, (gradient.abs() / steepest.clamp(min=TINY)).clamp(max=1.0).square()


def _lanczos2(squared_distance: Tensor, window: Tensor) -> Tensor:
    """AMD's polynomial in place of Lanczos's kernel with two lobes, but for a factor: it crosses zero at 1 and ends at `window`.

    (25/16 (2/5 d - 1)^2 - 9/16) (d / window - 1)^2 = (d - 1) (d - 4) (window - d)^2 / (2 window)^2, where d is the squared distance.
    """
    centred = squared_distance - 2.5
    return (centred.square() - 2.25) * (window - squared_distance).relu().square()


def rcas(rgb: Tensor, stops: float) -> Tensor:
    """Robust Contrast Adaptive Sharpening of RGB (N, 3, H, W) in [0, 1]; `stops` halve the sharpness, edges are replicated.

    Each pixel loses a share of its four neighbours, the same in all channels: as great as keeps all values that they could
    frame within [0, 1], and no greater than LOBE_LIMIT. The result may leave [0, 1] a little.
    """
    padded = F.pad(rgb, (1, 1, 1, 1), mode="replicate")
    ring = [padded[:, :, :-2, 1:-1], padded[:, :, 1:-1, :-2], padded[:, :, 1:-1, 2:], padded[:, :, 2:, 1:-1]]
    low, high = reduce(torch.minimum, ring), reduce(torch.maximum, ring)
    to_black = low / (4 * high).clamp(min=TINY)
    to_white = (1 - high) / (4 - 4 * low).clamp(min=TINY)
    lobe = torch.minimum(to_black, to_white).amin(1, keepdim=True).clamp(0.0, LOBE_LIMIT) * math.exp2(-stops)
    return (rgb - lobe * reduce(torch.add, ring)) / (1 - 4 * lobe)


class Fsr1(nn.Module):
    """EASU and RCAS, or EASU alone, on planes of code values: BT.709 limited-range 4:2:0 in, through RGB, and out."""

    def __init__(self, scale: int, *, sharpen: bool) -> None:
        super().__init__()
        self.to_rgb, self.easu, self.to_planes = PlanesToRgb(), Easu(scale), RgbToPlanes()
        self.sharpen = sharpen

    def forward(self, y: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rgb = self.easu(self.to_rgb(y, u, v).clamp(0.0, 1.0))
        if self.sharpen:
            rgb = rcas(rgb, SHARPNESS_STOPS).clamp(0.0, 1.0)
        planes: tuple[Tensor, Tensor, Tensor] = self.to_planes(rgb)
        return planes
