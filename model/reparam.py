"""Linear triples (1x1 expand, 3x3, 1x1 compress) that train wide and run as one 3x3 convolution."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@runtime_checkable
class Fusible(Protocol):
    """A module that trains in one form and runs in another."""

    def fused(self) -> nn.Module: ...

    def load_fused(self, plain: Any) -> None:
        """Take weights with which `fused()` is `plain` again, to train on from."""


class LinearTriple(nn.Module):
    """Three convolutions with nothing between them, equal to one 3x3 convolution (GameSR, section A.2).

    Takes (N, C, H, W) and gives the same, or without `padding` (N, C, H - 2, W - 2). `forward` collapses the weights and runs one
    convolution, so a training step costs what inference costs (SESR, "collapsible linear blocks") while the optimizer sees the
    wide parameters. With `nothing` all that it gives is zero before it is trained.
    """

    def __init__(self, channels: int, expanded: int, *, padding: int = 1, nothing: bool = False) -> None:
        super().__init__()
        self.padding = padding
        self.expand = nn.Conv2d(channels, expanded, 1)
        self.middle = nn.Conv2d(expanded, expanded, 3)
        self.compress = nn.Conv2d(expanded, channels, 1)
        self.reset()
        if nothing:
            nn.init.zeros_(self.compress.weight)
            assert self.compress.bias is not None
            nn.init.zeros_(self.compress.bias)

    def reset(self) -> None:
        """Draw the weights anew, at unit variance through all three: torch's default would leave a fifth of the signal."""
        for conv in (self.expand, self.middle, self.compress):
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

    @torch.no_grad()
    def load_fused(self, plain: nn.Conv2d) -> None:
        """The two 1x1 convolutions drawn anew, and the least change to the middle one with which all three equal `plain`.

        Many triples equal one convolution, and the one that was trained is not known: this one begins as others do.
        """
        self.reset()
        expand, compress = (conv.weight[:, :, 0, 0].double() for conv in (self.expand, self.compress))
        product = torch.einsum("om,mnyx,ni->oiyx", compress, self.middle.weight.double(), expand)
        missing = plain.weight.double() - product
        change = torch.einsum("mo,oiyx,in->mnyx", torch.linalg.pinv(compress), missing, torch.linalg.pinv(expand))
        self.middle.weight += change.to(self.middle.weight.dtype)
        biases = (self.expand.bias, self.middle.bias, self.compress.bias)
        for bias, value in zip(biases, (None, None, plain.bias), strict=True):
            assert bias is not None
            bias.zero_() if value is None else bias.copy_(value)


def fuse(module: nn.Module) -> nn.Module:
    """Replace everything inside `module` that has a cheaper equal (`fused()`) by it, in place; returns `module`."""
    for name, child in module.named_children():
        setattr(module, name, child.fused() if isinstance(child, Fusible) else fuse(child))
    return module


@torch.no_grad()
def load_fused(module: nn.Module, plain: nn.Module) -> None:
    """The way back from `fuse`: give `module`, in its training form, the weights of `plain`, the same one fused."""
    for name, parameter in module.named_parameters(recurse=False):
        parameter.copy_(plain.get_parameter(name))
    for name, child in module.named_children():
        if isinstance(child, Fusible):
            child.load_fused(plain.get_submodule(name))
        else:
            load_fused(child, plain.get_submodule(name))
