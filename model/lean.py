"""The live tiers' network: no memory, no norm, no padding inside, and layers that carry the picture's own cells to the head.

Convolutions are the cheap part of a network on a CPU that multiplies matrices; passes over memory beside them are not. So what runs is a
row of plain 3x3 convolutions and leaky ReLUs, all of one width: identities, the bicubic base and the cells that it needs are part of
their weights. A network so narrow that the cells would be a third of its layers adds the base by convolutions of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Literal, Self, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.interpolation import LearnedInterpolation, chroma_shift, exact, shuffle_channels_last
from model.planes import INPUT_GAIN, RESIDUAL_GAIN, LastLayer, Network, Planes, State
from model.reparam import LinearTriple, fuse, load_fused

ARCHITECTURE = "lean"
LEAK = 0.1  # of the ReLUs: without it, and without a norm, whole blocks died within a thousand steps
BLOCKS = (2, 1, 1)  # a cell's side in pixels of Y, U and V
CELL = sum(block**2 for block in BLOCKS)  # samples of a cell
MIDDLE = 128  # about which codes lie where a convolution has them alone: bfloat16 rounds what it gives, and about zero that is finer


@dataclass(frozen=True)
class LeanConfig:
    """Everything that decides the network's shape.

    `channels` is the width of what runs: features and, where they are `carried`, the six samples of a cell. AMX computes 32 in one go,
    AVX512 16, whatever part of them is used. In 8 bits no layer carries the cells, and the wide forms have features in their place.
    """

    scale: Literal[2, 3] = 2
    channels: int = 32
    expanded: int = 64
    blocks: int = 1
    carried: bool = True

    def __post_init__(self) -> None:
        if self.blocks < 0:
            raise ValueError(f"a network of {self.blocks} blocks would be larger than its input")

    @property
    def features(self) -> int:
        return self.channels - CELL * self.carried


LEAN: dict[str, dict[str, int]] = {
    "fast": {"channels": 16, "carried": False},
    "live": {},
    "live-wide": {"carried": False},
    "balanced": {"channels": 48},
    "balanced-wide": {"channels": 48, "carried": False},
}


class LeanBlock(nn.Module):
    """A linear triple, residual, leaky ReLU; (N, C, h, w) to (N, C, h - 2, w - 2)."""

    def __init__(self, channels: int, expanded: int) -> None:
        super().__init__()
        # It begins as nothing but the leak: depth costs no stability, and blocks can be added to a trained network.
        self.conv = LinearTriple(channels, expanded, padding=0, nothing=True)

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(x[:, :, 1:-1, 1:-1] + self.conv(x), LEAK)

    def fused(self) -> nn.Conv2d:
        """The convolution that runs before the ReLU, the identity being linear too (RepVGG, section 3.3)."""
        conv = self.conv.fused()
        with torch.no_grad():
            conv.weight[:, :, 1, 1] += torch.eye(conv.in_channels).to(conv.weight)
        return conv

    def load_fused(self, plain: nn.Conv2d) -> None:
        """Take the weights of a convolution that runs, and the identity out of them."""
        weight, bias = weight_and_bias(plain)
        weight[:, :, 1, 1] -= torch.eye(len(weight))
        self.conv.load_fused(convolution(weight, bias))


class Head(nn.Module):
    """What runs where no layer carries the cells: a convolution of the features and one of the cells, (N, C, h, w) each, added up.

    The bias is the second one's, which stays float in an int8 artifact. The cells, and so the samples, are about zero.
    """

    def __init__(self, features: nn.Conv2d, cells: nn.Conv2d) -> None:
        super().__init__()
        self.features, self.cells = features, cells

    def forward(self, features: Tensor, cells: Tensor) -> Tensor:
        return cast(Tensor, self.features(features) + self.cells(cells))


class FlatInterpolation(LearnedInterpolation):
    """A learned kernel that bfloat16 holds exactly and that still sums to one there: a flat area stays flat in either precision."""

    def kernel(self) -> Tensor:
        kernel = super().kernel()
        flat = kernel.detach().flatten(1).bfloat16().to(kernel.dtype)
        smallest = flat.abs().argmin(1, keepdim=True)  # where bfloat16 is finest
        rest = 1 - flat.sum(1, keepdim=True)
        flat.scatter_(1, smallest, (flat.gather(1, smallest) + rest).bfloat16().to(kernel.dtype))
        return flat.reshape(kernel.shape) + (kernel - kernel.detach())  # adds nothing but the kernel's gradient


class Lean(Network):
    """The network of a `LeanConfig`: planes of float code values in and out, neither rounded nor clamped.

    The decoded planes are extended by as many cells as the layers reach, edges replicated, and every convolution shrinks them by
    one: oneDNN takes half as long again over one that pads. Untrained it is bicubic interpolation, but for
    chroma, whose kernels are cut to the cells beside a cell, and for rounding the kernels to bfloat16.
    """

    def __init__(self, config: LeanConfig) -> None:
        super().__init__(config.scale, 2, {"architecture": ARCHITECTURE, **asdict(config)})
        self.config = config
        self.sides = [block * config.scale for block in BLOCKS]
        self.stem = nn.Conv2d(CELL, config.features, 3)
        self.blocks = nn.ModuleList(LeanBlock(config.features, config.expanded) for _ in range(config.blocks))
        self.head: nn.Module = convolution(torch.zeros(sum(side**2 for side in self.sides), config.features, 3, 3), torch.zeros(0))
        self.luma_base = FlatInterpolation("bicubic", config.scale, BLOCKS[0], reach=1)
        self.chroma_base = FlatInterpolation("bicubic", config.scale, BLOCKS[1], chroma_shift(config.scale), reach=1)
        self.running = False

    def step(
        self, frame: Planes, state: State | None, finish: Callable[[Tensor], Tensor] = lambda samples: samples
    ) -> tuple[Planes, State | None]:
        cells = self._cells(frame)
        x = cells if self.running else INPUT_GAIN * (cells / 255 - 0.5)
        x = F.leaky_relu(self.stem(x), LEAK)
        for block in self.blocks:
            x = F.leaky_relu(block(x), LEAK) if self.running else block(x)
        if self.running and not self.config.carried:
            cells = cells[:, :, self.reach - 1 : 1 - self.reach, self.reach - 1 : 1 - self.reach]
            luma = shuffle_channels_last(finish(self.head(x, cells) + MIDDLE), self.sides[0])
            chroma = shuffle_channels_last(finish(self.chroma_head(x, cells) + MIDDLE), self.sides[1], 2)
            return Planes(luma, *torch.split(chroma, 1, 1)), None
        x = self.head(x)
        if not self.running:
            with exact(x):
                base = torch.cat((self.luma_base(frame.y), self.chroma_base(frame.u), self.chroma_base(frame.v)), 1)
                x = base + 255 * RESIDUAL_GAIN * x.to(base.dtype)
        parts = torch.split(finish(x), [side**2 for side in self.sides], 1)
        return Planes(*(shuffle_channels_last(part, side) for part, side in zip(parts, self.sides, strict=True))), None

    def deployed(self) -> Self:
        """In place, the bases as convolutions of the cells, which are carried to them or stay apart.

        Carried, cells lie beside the features in every layer: codes are not negative, so the ReLUs let them through. Apart, luma
        and chroma have a head each, since taking apart what one gives takes as long as such a narrow convolution does.
        """
        fuse(self.blocks)
        bases = block_diagonal([base.kernel().detach().double() for base in (self.luma_base, self.chroma_base, self.chroma_base)])
        weight, bias = weight_and_bias(self.stem)
        weight, bias = INPUT_GAIN / 255 * weight, bias - self._gain_of_a_middle * weight.sum((1, 2, 3))
        head, head_bias = (255 * RESIDUAL_GAIN * part for part in weight_and_bias(self.head))
        if self.config.carried:
            onward = torch.zeros_like(bases[:CELL])
            onward[:, :, 1, 1] = torch.eye(CELL)
            weight = torch.cat((weight, onward))
            for index, block in enumerate(self.blocks):
                inner, inner_bias = weight_and_bias(block)
                self.blocks[index] = convolution(block_diagonal([inner, onward]), inner_bias).to(self.weight)
            self.head = convolution(torch.cat((head, bases), 1), head_bias).to(self.weight)
        else:
            luma = self.sides[0] ** 2
            head_bias = head_bias + MIDDLE * (bases.sum((1, 2, 3)) - 1)
            heads = [
                Head(convolution(head[part], None), convolution(bases[part], head_bias[part])).to(self.weight)
                for part in (slice(luma), slice(luma, None))
            ]
            self.head, self.chroma_head = heads
        self.stem = convolution(weight, bias).to(self.weight)
        del self.luma_base, self.chroma_base
        self.running = True
        return self

    def load_deployed(self, deployed: Self) -> None:
        features = self.config.features
        weight, bias = weight_and_bias(deployed.stem)
        weight = 255 / INPUT_GAIN * weight[:features]
        load_fused(self.stem, convolution(weight, bias[:features] + self._gain_of_a_middle * weight.sum((1, 2, 3))))
        plain = [weight_and_bias(block) for block in deployed.blocks]
        load_fused(self.blocks, nn.ModuleList(convolution(weight[:features, :features], bias[:features]) for weight, bias in plain))
        if self.config.carried:
            weight, bias = weight_and_bias(deployed.head)
            weight, bases = weight[:, :features], weight[:, features:]
        else:
            heads = [cast(Head, head) for head in (deployed.head, deployed.chroma_head)]
            weight = torch.cat([head.features.weight.detach().double() for head in heads])
            bases, bias = (torch.cat(parts) for parts in zip(*(weight_and_bias(head.cells) for head in heads), strict=True))
            bias = bias - MIDDLE * (bases.sum((1, 2, 3)) - 1)
        load_fused(self.head, convolution(weight / (255 * RESIDUAL_GAIN), bias / (255 * RESIDUAL_GAIN)))
        luma, chroma = self.sides[0] ** 2, self.sides[1] ** 2
        self.luma_base.load_kernel(bases[:luma, :-2])
        self.chroma_base.load_kernel(bases[luma : luma + chroma, -2:-1])

    def last_layer(self) -> LastLayer:
        if self.config.carried:
            assert isinstance(self.head, nn.Conv2d) and self.head.bias is not None
            module, weights, biases = self.head, [self.head.weight], [self.head.bias]
        else:
            heads = [cast(Head, head) for head in (self.head, self.chroma_head)]
            module, weights = heads[0].features, [head.features.weight for head in heads]
            biases = [cast(Tensor, head.cells.bias) for head in heads]
        return LastLayer(module, self.config.features, tuple(weights), tuple(biases), tuple(self.sides), padding=0, gain=1)

    def apart(self) -> Lean:
        """The same network in the form that is trained, of which no layer carries the cells once it is deployed."""
        network = Lean(replace(self.config, channels=self.config.features, carried=False))
        network.load_state_dict(self.state_dict())
        return network

    def widened(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The weights of a narrower network of as many blocks, in training form, as weights of this one, which gives the same with them.

        What further features it has are as they were drawn, and nothing reads them yet. The head of another scale is left out.
        """
        wide = {}
        for name, own in self.state_dict().items():
            given = weights[name]
            grows = name.startswith(("stem.", "blocks.")) or len(given) == len(own)
            if grows and all(few <= many for few, many in zip(given.shape, own.shape, strict=True)):
                wide[name] = own.clone()
                if own.dim() > 1:
                    wide[name][:, given.shape[1] :] = 0
                wide[name][tuple(map(slice, given.shape))] = given
        return wide

    @property
    def _gain_of_a_middle(self) -> float:
        """Minus the stem's input in training where what runs gives it zero."""
        return INPUT_GAIN * (0.5 - (0 if self.config.carried else MIDDLE) / 255)

    @property
    def reach(self) -> int:
        """How many cells away the layers see: the stem, the blocks and the head one each."""
        return self.config.blocks + 2

    def _cells(self, frame: Planes) -> Tensor:
        """Cells (N, 6, H/2 + 2R, W/2 + 2R) of the planes, extended by the R cells that the layers reach."""
        planes: list[Tensor] = [plane - MIDDLE for plane in frame] if self.running and not self.config.carried else list(frame)
        planes = [F.pad(plane, (self.reach * block,) * 4, mode="replicate") for plane, block in zip(planes, BLOCKS, strict=True)]
        return torch.cat([F.pixel_unshuffle(plane, block) for plane, block in zip(planes, BLOCKS, strict=True)], 1)


def convolution(weight: Tensor, bias: Tensor | None) -> nn.Conv2d:
    """One with the given weights, in their dtype and without padding; outputs beyond the biases have none."""
    conv = nn.Conv2d(weight.shape[1], weight.shape[0], 3, bias=bias is not None, dtype=weight.dtype)
    with torch.no_grad():
        conv.weight.copy_(weight)
        if bias is not None and conv.bias is not None:
            conv.bias.zero_()[: len(bias)] = bias
    return conv


def weight_and_bias(conv: nn.Module) -> tuple[Tensor, Tensor]:
    """Those of a convolution, in float64."""
    assert isinstance(conv, nn.Conv2d) and conv.bias is not None
    return conv.weight.detach().double(), conv.bias.detach().double()


def block_diagonal(kernels: list[Tensor]) -> Tensor:
    """Kernels (O, I, h, w) of convolutions beside each other as that of one, zero between them."""
    inputs, outputs = sum(k.shape[1] for k in kernels), sum(k.shape[0] for k in kernels)
    whole = kernels[0].new_zeros(outputs, inputs, *kernels[0].shape[2:])
    row = column = 0
    for kernel in kernels:
        whole[row : row + kernel.shape[0], column : column + kernel.shape[1]] = kernel
        row, column = row + kernel.shape[0], column + kernel.shape[1]
    return whole
