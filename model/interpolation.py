"""Interpolation as a fixed convolution on pixel-unshuffled cells: the residual base, the baselines, chroma resampling.

A plane cut into cells of b x b pixels becomes b*b channels (PixelUnshuffle). Resizing by r then maps a neighbourhood of
cells to the (b*r)^2 pixels of one output cell by constant weights, which is a convolution followed by PixelShuffle(b*r).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Of Y, U and V: codes about these are interpolated as numbers about zero. What bfloat16 does to a kernel then counts for that much less,
# and so does what it does to a result that a runtime keeps in it: 128 and more would be rounded to whole numbers, 64 and more to halves.
MIDDLES = (64.0, 128.0, 128.0)


def linear(t: float) -> float:
    return max(0.0, 1.0 - abs(t))


def bicubic(t: float, a: float = -0.75) -> float:
    """Keys' cubic convolution kernel; a = -0.75 as in OpenCV and torch (Keys 1981, eq. 4, has -0.5)."""
    t = abs(t)
    if t < 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    if t < 2:
        return a * (t**3 - 5 * t**2 + 8 * t - 4)
    return 0.0


def lanczos(t: float, lobes: int = 3) -> float:
    """The sinc function windowed by its own central lobe, three lobes each side."""
    if t == 0:
        return 1.0
    if abs(t) >= lobes:
        return 0.0
    x = math.pi * t
    return lobes * math.sin(x) * math.sin(x / lobes) / x**2


KERNELS: dict[str, tuple[Callable[[float], float], int]] = {
    "linear": (linear, 1),
    "bicubic": (bicubic, 2),
    "lanczos": (lanczos, 3),
}


def chroma_shift(scale: int) -> float:
    """How far right of the centred position an output chroma sample reads, in input chroma samples.

    4:2:0 chroma of H.264 is left-sited (ITU-T H.264, figure E-1, type 0): it shares its column with the even luma sample.
    Scaling luma about pixel centres then moves chroma by (1 - 1/scale) / 4.
    """
    return 0.25 * (1 - 1 / scale)


def phase_weights(kernel: str, scale: int, block: int, shift: float) -> Tensor:
    """Weights (block*scale, block, cells) float64 of one axis: output pixel of a cell, input pixel of a cell, cell offset."""
    function, support = KERNELS[kernel]
    positions = [(p + 0.5) / scale - 0.5 + shift for p in range(block * scale)]
    taps = {p: [q for q in range(math.ceil(t - support), math.floor(t + support) + 1) if function(t - q)] for p, t in enumerate(positions)}
    radius = max(abs(math.floor(q / block)) for qs in taps.values() for q in qs)
    weights = torch.zeros(block * scale, block, 2 * radius + 1, dtype=torch.float64)
    for p, t in enumerate(positions):
        for q in taps[p]:
            weights[p, q % block, q // block + radius] = function(t - q)
    return weights / weights.sum((1, 2), keepdim=True)


def exact(like: Tensor) -> torch.autocast:
    """Switches mixed precision off: code values and colour matrices do not survive bfloat16."""
    return torch.autocast(like.device.type, enabled=False)


class Interpolation(nn.Module):
    """Resize one-channel planes by an integer factor, edges replicated.

    Takes (N, 1, H, W) with H and W multiples of `block`; gives (N, (block*scale)^2, H/block, W/block), which
    PixelShuffle(block*scale) turns into (N, 1, scale*H, scale*W). `shift` moves the sampling to the right, in input pixels.
    """

    weight: Tensor

    def __init__(self, kernel: str, scale: int, block: int = 1, shift: float = 0.0) -> None:
        super().__init__()
        self.block = block
        vertical, horizontal = phase_weights(kernel, scale, block, 0.0), phase_weights(kernel, scale, block, shift)
        self.pad = [block * (w.shape[2] // 2) for w in (horizontal, horizontal, vertical, vertical)]
        weight = torch.einsum("iay,jbx->ijabyx", vertical, horizontal)
        side = block * scale
        self.register_buffer("weight", weight.reshape(side * side, block * block, *weight.shape[4:]), persistent=False)

    def forward(self, plane: Tensor) -> Tensor:
        with exact(plane):
            cells = F.pixel_unshuffle(F.pad(plane, self.pad, mode="replicate"), self.block)
            return F.conv2d(cells, self.kernel().to(cells.dtype))

    def kernel(self) -> Tensor:
        """Weights ((block*scale)^2, block^2, cells, cells)."""
        return self.weight


class LearnedInterpolation(Interpolation):
    """Interpolation whose kernel training may bend, by `reach` cells around, without ever changing a flat area.

    The linear part of super-resolution is a sharpening filter; learned here it costs nothing at run time, since the
    interpolation is a convolution anyway. The correction is centred per output pixel, so every kernel still sums to one. A kernel
    that reaches further than `reach` is cut there and normalized again.
    """

    GAIN = 0.1  # a step of the optimizer then moves the picture by a tenth of what it moves the parameter

    def __init__(self, kernel: str, scale: int, block: int = 1, shift: float = 0.0, reach: int = 2) -> None:
        super().__init__(kernel, scale, block, shift)
        grow = reach - self.weight.shape[2] // 2
        self.weight = F.pad(self.weight, (grow,) * 4)
        self.weight /= self.weight.sum((1, 2, 3), keepdim=True)
        self.pad = [block * reach] * 4
        self.correction = nn.Parameter(torch.zeros(self.weight.shape, dtype=torch.get_default_dtype()))

    def kernel(self) -> Tensor:
        centred = self.correction - self.correction.mean((1, 2, 3), keepdim=True)
        return self.weight.to(centred.dtype) + self.GAIN * centred

    def fused(self) -> Interpolation:
        """A plain interpolation with the learned kernel as its parameter."""
        plain = Interpolation("linear", 1, self.block)
        plain.pad = self.pad
        del plain.weight
        plain.weight = nn.Parameter(self.kernel().detach().clone())
        return plain

    def load_fused(self, plain: Interpolation) -> None:
        """Take the kernel of a fused interpolation."""
        self.load_kernel(plain.kernel())

    @torch.no_grad()
    def load_kernel(self, kernel: Tensor) -> None:
        """Take a kernel, as long as its weights sum to one."""
        self.correction.copy_((kernel - self.weight) / self.GAIN)


def shuffle_channels_last(cells: Tensor, block: int, planes: int = 1) -> Tensor:
    """PixelShuffle, (N, planes*block^2, h, w) to (N, planes, block*h, block*w), by way of the layout that convolutions leave.

    There it moves rows of `block` samples. DepthToSpace takes twice as long in OpenVINO and a fifth longer in ONNX Runtime, which on a GPU
    has none of uint8 and would bring the samples to the processor for it.
    """
    n, _, h, w = cells.shape
    rows = cells.permute(0, 2, 3, 1).reshape(n, h, w, *([planes] if planes > 1 else []), block, block)
    order = (0, 3, 1, 4, 2, 5) if planes > 1 else (0, 1, 3, 2, 4)
    return rows.permute(order).reshape(n, planes, block * h, block * w)
