"""BT.709 limited-range planes to RGB and back, inside the graph, for the networks that think in RGB."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.interpolation import Interpolation, exact

KR, KB = 0.2126, 0.0722  # ITU-R BT.709-6, item 3.2
KG = 1 - KR - KB


def yuv_to_rgb_matrix() -> Tensor:
    """(3, 3) float64 from (Y - 16, U - 128, V - 128) code values to R, G, B in [0, 1]; BT.709, limited range, 8 bit."""
    y, c = 1 / 219, 1 / 224
    return torch.tensor(
        [
            [y, 0.0, 2 * (1 - KR) * c],
            [y, -2 * (1 - KB) * KB / KG * c, -2 * (1 - KR) * KR / KG * c],
            [y, 2 * (1 - KB) * c, 0.0],
        ],
        dtype=torch.float64,
    )


class PlanesToRgb(nn.Module):
    """Planes of code values to RGB (N, 3, H, W), not clamped; chroma raised bilinearly from its left-sited position."""

    matrix: Tensor
    offset: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.chroma = Interpolation("linear", 2, 1, 0.25)
        self.register_buffer("matrix", yuv_to_rgb_matrix()[:, :, None, None], persistent=False)
        self.register_buffer("offset", torch.tensor([16.0, 128.0, 128.0])[:, None, None], persistent=False)

    def forward(self, y: Tensor, u: Tensor, v: Tensor) -> Tensor:
        yuv = torch.cat((y, F.pixel_shuffle(self.chroma(u), 2), F.pixel_shuffle(self.chroma(v), 2)), 1)
        with exact(y):
            return F.conv2d(yuv - self.offset.to(y.dtype), self.matrix.to(y.dtype))


class RgbToPlanes(nn.Module):
    """RGB (N, 3, H, W) to planes of code values; chroma lowered by [1 2 1]/4 about the even column and a pair of rows."""

    matrix: Tensor
    offset: Tensor
    chroma: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("matrix", torch.linalg.inv(yuv_to_rgb_matrix())[:, :, None, None], persistent=False)
        self.register_buffer("offset", torch.tensor([16.0, 128.0, 128.0])[:, None, None], persistent=False)
        taps = torch.outer(torch.tensor([0.5, 0.5]), torch.tensor([0.25, 0.5, 0.25]))
        self.register_buffer("chroma", taps.expand(2, 1, 2, 3).contiguous(), persistent=False)

    def forward(self, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        with exact(rgb):
            yuv = F.conv2d(rgb, self.matrix.to(rgb.dtype)) + self.offset.to(rgb.dtype)
            chroma = torch.cat((yuv[:, 1:, :, :1], yuv[:, 1:]), 3)  # the left edge replicated
            chroma = F.conv2d(chroma, self.chroma.to(rgb.dtype), stride=2, groups=2)
        return yuv[:, :1], chroma[:, :1], chroma[:, 1:]
