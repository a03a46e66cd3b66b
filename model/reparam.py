"""Linear triples (1x1 expand, 3x3, 1x1 compress) that train wide and run as one 3x3 convolution."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@runtime_checkable
class Fusible(Protocol):
    """A module that trains in one form and runs in another."""

    def fused(self) -> nn.Module: ...


class LinearTriple(nn.Module):
    """Three convolutions with nothing between them, equal to one 3x3 convolution (GameSR, section A.2).

    Takes (N, C, H, W) and gives the same, or without `padding` (N, C, H - 2, W - 2). `forward` collapses the weights and runs one
    convolution, so a training step costs what inference costs (SESR, "collapsible linear blocks") while the optimizer sees the
    wide parameters.
    """

    def __init__(self, channels: int, expanded: int, *, padding: int = 1) -> None:
        super().__init__()
        self.padding = padding
        self.expand = nn.Conv2d(channels, expanded, 1)
        self.middle = nn.Conv2d(expanded, expanded, 3)
        self.compress = nn.Conv2d(expanded, channels, 1)
        for conv in (self.expand, self.middle, self.compress):
            # Kept at unit variance through all three: torch's default would leave a fifth of the signal.
            nn.init.kaiming_normal_(conv.weight, nonlinearity="linear")

    def collapsed(self) -> tuple[Tensor, Tensor]:
        """Weight (C, C, 3, 3) and bias (C) of the one convolution that equals the three."""
        expand = self.expand.weight[:, :, 0, 0]
        compress = self.compress.weight[:, :, 0, 0]
        middle, middle_bias = self.middle.weight, self.middle.bias
        assert self.expand.bias is not None and middle_bias is not None and self.compress.bias is not None
        weight = torch.einsum("om,mnyx,ni->oiyx", compress, middle, expand)
        bias = compress @ (middle.sum((2, 3)) @ self.expand.bias + middle_bias) + self.compress.bias
        return weight, bias

    def forward(self, x: Tensor) -> Tensor:
        weight, bias = self.collapsed()
        return F.conv2d(x, weight, bias, padding=self.padding)

    def forward_unfused(self, x: Tensor) -> Tensor:
        """The three convolutions one after the other; the reference for `forward`.

        The zero ring is added before the expanding 1x1, so that the ring holds that convolution's bias: padding after
        it would differ from the fused form on every border pixel.
        """
        out: Tensor = self.compress(self.middle(self.expand(F.pad(x, (self.padding,) * 4))))
        return out

    def fused(self) -> nn.Conv2d:
        """A plain 3x3 convolution with the collapsed weights, computed in float64."""
        wide = LinearTriple(self.expand.in_channels, self.expand.out_channels).double()
        wide.load_state_dict(self.state_dict())
        weight, bias = wide.collapsed()
        conv = nn.Conv2d(self.expand.in_channels, self.compress.out_channels, 3, padding=self.padding)
        conv.to(self.expand.weight.device, self.expand.weight.dtype)
        with torch.no_grad():
            conv.weight.copy_(weight)
            assert conv.bias is not None
            conv.bias.copy_(bias)
        return conv


def fuse(module: nn.Module) -> nn.Module:
    """Replace everything inside `module` that has a cheaper equal (`fused()`) by it, in place; returns `module`."""
    for name, child in module.named_children():
        setattr(module, name, child.fused() if isinstance(child, Fusible) else fuse(child))
    return module
