"""GameSR: a recurrent super-resolution network over decoded 4:2:0 frames, one module for a frame and for a clip.

The configuration `paper` is the network of the GameSR paper (figure 2, sections 3.2 and A.2); `planes` is ours: the same
blocks between the decoder's own Y, U and V planes, without any colour conversion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.colour import PlanesToRgb, RgbToPlanes
from model.interpolation import Interpolation, LearnedInterpolation, chroma_shift
from model.planes import Network, Planes, State
from model.reparam import LinearTriple


@dataclass(frozen=True)
class NetworkConfig:
    """Everything that decides a network's shape.

    `unshuffle` is PixelUnshuffle's factor (1: none); an input's height and width are multiples of `size_multiple`.
    `learned_base` lets training bend the bicubic kernel under the residual, and `skip` adds the ConvLSTM's input to its
    output, so that detail need not pass through gates that saturate; both are ours, not the paper's. `lean` has neither GELU nor
    LayerNorm, which take longer than the convolutions where those run in bfloat16 or int8, and a base that reaches one cell.
    """

    scale: Literal[2, 3] = 2
    colour: Literal["planes", "rgb"] = "planes"
    unshuffle: int = 2
    channels: int = 32
    expanded: int = 64
    blocks: int = 5
    recurrent: bool = True
    learned_base: bool = False
    skip: bool = False
    lean: bool = False

    def __post_init__(self) -> None:
        if self.colour == "planes" and self.unshuffle % 2:
            raise ValueError("a planes network needs an even unshuffle, which brings luma to the size of chroma")
        if self.lean and not (self.colour == "planes" and self.learned_base):
            raise ValueError("a lean network is one of planes, with a base that is learned")

    @property
    def size_multiple(self) -> int:
        return max(2, self.unshuffle)


LEAN: dict[str, object] = {"learned_base": True, "lean": True, "recurrent": False}
PRESETS: dict[str, dict[str, object]] = {
    "planes": {"learned_base": True, "skip": True},
    "planes-no-lstm": {"learned_base": True, "recurrent": False},
    "planes-plain": {},
    "live": {**LEAN, "blocks": 2},
    "balanced": {**LEAN, "blocks": 6},
    "paper": {"colour": "rgb"},
    "paper-no-lstm": {"colour": "rgb", "recurrent": False},
    "paper-no-unshuffle": {"colour": "rgb", "unshuffle": 1},
}


# Detail is a few hundredths of the code range: brought nearer to the unit scale of the layers, both ways, it trains faster.
INPUT_GAIN = 4.0
RESIDUAL_GAIN = 0.1


class FeatureBlock(nn.Module):
    """FEB: a linear triple, GELU, residual, LayerNorm over channels (section 3.2; the order is that of section A.2)."""

    def __init__(self, channels: int, expanded: int) -> None:
        super().__init__()
        self.conv: nn.Module = LinearTriple(channels, expanded)
        self.norm = nn.LayerNorm(channels)

    def forward(self, x: Tensor) -> Tensor:
        x = x + F.gelu(self.conv(x))
        out: Tensor = self.norm(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
        return out


LEAK = 0.1  # of a lean network's ReLUs: without it, and without a norm, whole blocks died within a thousand steps


class LeanBlock(nn.Module):
    """A linear triple, residual, leaky ReLU: a convolution and the ReLU when fused, the identity being linear too (RepVGG, section 3.3)."""

    def __init__(self, channels: int, expanded: int) -> None:
        super().__init__()
        self.conv = LinearTriple(channels, expanded)
        # It begins as nothing but the leak: depth costs no stability, and blocks can be added to a trained network.
        nn.init.zeros_(self.conv.compress.weight)
        assert self.conv.compress.bias is not None
        nn.init.zeros_(self.conv.compress.bias)

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(x + self.conv(x), LEAK)

    def fused(self) -> nn.Module:
        conv = self.conv.fused()
        with torch.no_grad():
            conv.weight[:, :, 1, 1] += torch.eye(conv.in_channels).to(conv.weight)
        return nn.Sequential(conv, nn.LeakyReLU(LEAK))


class ConvLstm(nn.Module):
    """A ConvLSTM cell whose four gates are one convolution over [x, h] (Shi et al. 2015, eq. 3, without peepholes)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1)
        with torch.no_grad():
            assert self.gates.bias is not None
            self.gates.bias[channels : 2 * channels] = 1.0  # the forget gate starts open (Jozefowicz et al. 2015)

    def forward(self, x: Tensor, state: State) -> State:
        i, f, o, g = self.gates(torch.cat((x, state.h), 1)).chunk(4, 1)
        c = torch.sigmoid(f) * state.c + torch.sigmoid(i) * torch.tanh(g)
        return State(torch.sigmoid(o) * torch.tanh(c), c)


class MergedHead(nn.Module):
    """A head and the interpolation under it as one convolution, of features and of the planes' own cells.

    Takes features (N, C, h, w) and the cells of edge-replicated planes (N, S, h + 2, w + 2) of 2 * code - 255, which bfloat16
    holds exactly; gives the cells of the picture in code values.
    """

    def __init__(self, features: int, cells: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(features + cells, outputs, 3)

    def forward(self, features: Tensor, cells: Tensor) -> Tensor:
        out: Tensor = self.conv(torch.cat((F.pad(features, (1, 1, 1, 1)), cells), 1))
        return out


class GameSR(Network):
    """The network of a `NetworkConfig`: `step` takes a frame and a state, `forward` a clip; both are the same graph.

    Pictures go in and come out as `Planes` of float code values; the output is neither rounded nor clamped. The head's
    (or tail's) last convolution starts at zero, so an untrained network is bicubic interpolation; but for the chroma of a lean one,
    whose kernels are cut to the cells beside a cell.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config.scale, config.size_multiple, asdict(config))
        self.config = config
        c, s, r = config.channels, config.unshuffle, config.scale
        side = s * r
        if config.colour == "planes":
            inputs, outputs = s * s + 2 * (s // 2) ** 2, side**2 + 2 * (side // 2) ** 2
            self.luma_base = self._base(s, 0.0)
            self.chroma_base = self._base(s // 2, chroma_shift(r))
        else:
            inputs, outputs = 3 * s * s, 3 * side**2
            self.to_rgb, self.to_planes = PlanesToRgb(), RgbToPlanes()
            self.rgb_base = Interpolation("bicubic", r, s)
            self.tail = nn.Conv2d(3, 3, 3, padding=1)
        self.stem = nn.Conv2d(inputs, c, 3, padding=1)
        block = LeanBlock if config.lean else FeatureBlock
        self.blocks = nn.ModuleList(block(c, config.expanded) for _ in range(config.blocks))
        self.lstm = ConvLstm(c) if config.recurrent else None
        self.head: nn.Conv2d | MergedHead = nn.Conv2d(c, outputs, 3, padding=1)
        last = self.head if config.colour == "planes" else self.tail
        nn.init.zeros_(last.weight)
        assert last.bias is not None
        nn.init.zeros_(last.bias)

    def initial_state(self, batch: int, height: int, width: int) -> State | None:
        """Zeros for input frames of the given size; None for a network without recurrence."""
        if self.lstm is None:
            return None
        s = self.config.unshuffle
        zeros = self.stem.weight.new_zeros(batch, self.config.channels, height // s, width // s)
        return State(zeros, torch.zeros_like(zeros))  # two tensors: an exporter takes one given twice for one input

    def step(
        self, frame: Planes, state: State | None, finish: Callable[[Tensor], Tensor] = lambda samples: samples
    ) -> tuple[Planes, State | None]:
        """One frame, planes (N, 1, H, W) and (N, 1, H/2, W/2), and the state after it.

        `finish` is applied to every sample of the picture where that costs least: before PixelShuffle moves them, if it can.
        """
        source = self._source(frame)
        features = self._features(source)
        if self.lstm is not None:
            assert state is not None
            state = self.lstm(features, state)
            features = state.h + features if self.config.skip else state.h
        return self._picture(frame, source, features, finish), state

    def forward(self, clip: Planes, state: State | None = None) -> tuple[Planes, State | None]:
        """A clip, planes (N, T, 1, H, W) and (N, T, 1, H/2, W/2): `step` over T, the parts without memory batched."""
        batch, steps, _, height, width = clip.y.shape
        frames = clip.flatten_time()
        source = self._source(frames)
        features = self._features(source)
        if self.lstm is not None:
            state = state or self.initial_state(batch, height, width)
            assert state is not None
            hidden = []
            for x in features.reshape(batch, steps, *features.shape[1:]).unbind(1):
                state = self.lstm(x, state)
                hidden.append(state.h)
            remembered = torch.stack(hidden, 1).flatten(0, 1)
            features = remembered + features if self.config.skip else remembered
        return self._picture(frames, source, features, lambda samples: samples).unflatten_time(batch), state

    def deployed(self) -> Self:
        """Triples become one convolution, and a base that reaches one cell goes into the head."""
        super().deployed()
        if self.config.lean:
            self._merge_base()
        return self

    def _merge_base(self) -> None:
        """Make the head and the base under it one convolution, in place; only of a fused network whose base reaches one cell."""
        assert isinstance(self.head, nn.Conv2d) and self.head.bias is not None
        bases = [base.kernel().double() for base in (self.luma_base, self.chroma_base, self.chroma_base)]
        merged = MergedHead(self.config.channels, self.stem.in_channels, self.head.out_channels).to(self.head.weight)
        assert merged.conv.bias is not None
        with torch.no_grad():
            # codes are (x + 255) / 2 of what goes in, and every kernel of the base sums to one
            merged.conv.weight.copy_(
                torch.cat((255 * RESIDUAL_GAIN * self.head.weight.double(), 0.5 * block_diagonal(bases).to(self.head.weight.device)), 1)
            )
            merged.conv.bias.copy_(255 * RESIDUAL_GAIN * self.head.bias.double() + 127.5)
            self.stem.weight.mul_(INPUT_GAIN / 510)
        self.head = merged
        del self.luma_base, self.chroma_base

    def _base(self, block: int, shift: float) -> Interpolation:
        scale = self.config.scale
        if not self.config.learned_base:
            return Interpolation("bicubic", scale, block, shift)
        return LearnedInterpolation("bicubic", scale, block, shift, reach=1 if self.config.lean else 2)

    def _source(self, frame: Planes) -> Tensor:
        """What the layers see: the planes' cells around zero, with one more around them for a merged head, or RGB."""
        if self.config.colour == "rgb":
            rgb: Tensor = self.to_rgb(*frame)
            return rgb
        s = self.config.unshuffle
        blocks = (s, s // 2, s // 2)
        if isinstance(self.head, MergedHead):
            frame = Planes(*(F.pad(plane, (b, b, b, b), mode="replicate") for plane, b in zip(frame, blocks, strict=True)))
        cells = torch.cat([F.pixel_unshuffle(plane, b) for plane, b in zip(frame, blocks, strict=True)], 1)
        return 2 * cells - 255 if isinstance(self.head, MergedHead) else cells / 255 - 0.5

    def _features(self, source: Tensor) -> Tensor:
        if isinstance(self.head, MergedHead):
            x = self.stem(source[:, :, 1:-1, 1:-1])
        elif self.config.colour == "rgb":
            x = self.stem(INPUT_GAIN * F.pixel_unshuffle(source - 0.5, self.config.unshuffle))
        else:
            x = self.stem(INPUT_GAIN * source)
        total = x = F.leaky_relu(x, LEAK) if self.config.lean else F.relu(x)
        for block in self.blocks:
            x = block(x)
            total = x if self.config.lean else total + x
        return total

    def _picture(self, frame: Planes, source: Tensor, features: Tensor, finish: Callable[[Tensor], Tensor]) -> Planes:
        side = self.config.unshuffle * self.config.scale
        if self.config.colour == "rgb":
            residual = self.tail(F.pixel_shuffle(F.relu(self.head(features)), side))
            channels = source.flatten(0, 1).unsqueeze(1)
            base = F.pixel_shuffle(self.rgb_base(channels), side).reshape(residual.shape)
            return Planes(*(finish(p) for p in self.to_planes(base + RESIDUAL_GAIN * residual.to(base.dtype))))
        if isinstance(self.head, MergedHead):
            cells = self.head(features, source)
        else:
            base = torch.cat((self.luma_base(frame.y), self.chroma_base(frame.u), self.chroma_base(frame.v)), 1)
            # cells of bicubic code values plus the head's residual, still one pixel a channel
            cells = base + 255 * RESIDUAL_GAIN * self.head(features).to(base.dtype)
        n, m = side**2, (side // 2) ** 2
        parts = zip(torch.split(finish(cells), [n, m, m], 1), (side, side // 2, side // 2), strict=True)
        shuffle = shuffle_channels_last if isinstance(self.head, MergedHead) else F.pixel_shuffle
        return Planes(*(shuffle(part, block) for part, block in parts))


def shuffle_channels_last(cells: Tensor, block: int) -> Tensor:
    """PixelShuffle of one plane, (N, block^2, h, w) to (N, 1, block*h, block*w), by way of the layout that convolutions leave.

    There it moves rows of `block` samples; OpenVINO's DepthToSpace takes twice as long.
    """
    n, _, h, w = cells.shape
    rows = cells.permute(0, 2, 3, 1).reshape(n, h, w, block, block).permute(0, 1, 3, 2, 4)
    return rows.reshape(n, 1, block * h, block * w)


def block_diagonal(kernels: list[Tensor]) -> Tensor:
    """Kernels (O, I, h, w) of convolutions beside each other as that of one, zero between them."""
    inputs, outputs = sum(k.shape[1] for k in kernels), sum(k.shape[0] for k in kernels)
    whole = kernels[0].new_zeros(outputs, inputs, *kernels[0].shape[2:])
    row = column = 0
    for kernel in kernels:
        whole[row : row + kernel.shape[0], column : column + kernel.shape[1]] = kernel
        row, column = row + kernel.shape[0], column + kernel.shape[1]
    return whole
