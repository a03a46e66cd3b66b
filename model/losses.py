"""What training minimizes: a sum of errors, or the logarithms of the errors, as PSNR counts them."""

from __future__ import annotations

import torch
from torch import Tensor

from model.planes import Planes

LOSSES = ("charbonnier", "psnr")
PLANE_SHARES = (0.75, 0.125, 0.125)  # of Y, U and V in PSNR-YUV (Ohm et al. 2012)
MSE_FLOOR = 0.1  # in codes squared, 58 dB: what is nearer than rounding takes it need not be learned


def charbonnier(output: Planes, target: Planes, eps: float) -> Tensor:
    """Mean of sqrt(d^2 + eps^2) over all samples of all planes, d in units of the code range (paper, section 4.1)."""
    total = sum(((a - b).div(255).square() + eps * eps).sqrt().sum() for a, b in zip(output, target, strict=True))
    assert isinstance(total, Tensor)
    return total / sum(plane.numel() for plane in target)


def mean_log_mse(output: Planes, target: Planes) -> Tensor:
    """Mean over the clips, planes (N, T, 1, H, W), of ln(MSE) of each plane, weighted as in PSNR-YUV: that PSNR, turned round.

    In a sum of errors the clips and planes that are hard to predict drown the others: chroma and what is nearly right
    hardly learn. Here a percent less error counts the same everywhere.
    """
    clips = [
        share * ((a - b).square().mean((1, 2, 3, 4)) + MSE_FLOOR).log() for share, a, b in zip(PLANE_SHARES, output, target, strict=True)
    ]
    return torch.stack(clips).sum(0).mean()
