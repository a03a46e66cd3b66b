"""GameSR: a recurrent super-resolution network over decoded 4:2:0 frames, one module for a frame and for a clip.

The configuration `paper` is the network of the GameSR paper (figure 2, sections 3.2 and A.2); `planes` is ours: the same
blocks between the decoder's own Y, U and V planes, without any colour conversion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.colour import PlanesToRgb, RgbToPlanes
from model.interpolation import Interpolation, LearnedInterpolation, chroma_shift
from model.reparam import LinearTriple


class Planes(NamedTuple):
    """The planes of 4:2:0 frames as 8-bit code values held in floats: y (..., 1, H, W), u and v (..., 1, H/2, W/2)."""

    y: Tensor
    u: Tensor
    v: Tensor

    def flatten_time(self) -> Planes:
        """(N, T, 1, H, W) planes as (N*T, 1, H, W)."""
        return Planes(*(plane.flatten(0, 1) for plane in self))

    def unflatten_time(self, batch: int) -> Planes:
        return Planes(*(plane.reshape(batch, -1, *plane.shape[1:]) for plane in self))


class State(NamedTuple):
    """The ConvLSTM's hidden and cell state, each (N, channels, H/unshuffle, W/unshuffle)."""

    h: Tensor
    c: Tensor


@dataclass(frozen=True)
class NetworkConfig:
    """Everything that decides a network's shape.

    `unshuffle` is PixelUnshuffle's factor (1: none); an input's height and width are multiples of `size_multiple`.
    `learned_base` lets training bend the bicubic kernel under the residual, and `skip` adds the ConvLSTM's input to its
    output, so that detail need not pass through gates that saturate; both are ours, not the paper's.
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

    def __post_init__(self) -> None:
        if self.colour == "planes" and self.unshuffle % 2:
            raise ValueError("a planes network needs an even unshuffle, which brings luma to the size of chroma")

    @property
    def size_multiple(self) -> int:
        return max(2, self.unshuffle)


PRESETS: dict[str, dict[str, object]] = {
    "planes": {"learned_base": True, "skip": True},
    "planes-no-lstm": {"learned_base": True, "recurrent": False},
    "planes-plain": {},
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


class GameSR(nn.Module):
    """The network of a `NetworkConfig`: `step` takes a frame and a state, `forward` a clip; both are the same graph.

    Pictures go in and come out as `Planes` of float code values; the output is neither rounded nor clamped. The head's
    (or tail's) last convolution starts at zero, so an untrained network is bicubic interpolation.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        c, s, r = config.channels, config.unshuffle, config.scale
        side = s * r
        if config.colour == "planes":
            inputs, outputs = s * s + 2 * (s // 2) ** 2, side**2 + 2 * (side // 2) ** 2
            base = LearnedInterpolation if config.learned_base else Interpolation
            self.luma_base = base("bicubic", r, s)
            self.chroma_base = base("bicubic", r, s // 2, chroma_shift(r))
        else:
            inputs, outputs = 3 * s * s, 3 * side**2
            self.to_rgb, self.to_planes = PlanesToRgb(), RgbToPlanes()
            self.rgb_base = Interpolation("bicubic", r, s)
            self.tail = nn.Conv2d(3, 3, 3, padding=1)
        self.stem = nn.Conv2d(inputs, c, 3, padding=1)
        self.blocks = nn.ModuleList(FeatureBlock(c, config.expanded) for _ in range(config.blocks))
        self.lstm = ConvLstm(c) if config.recurrent else None
        self.head = nn.Conv2d(c, outputs, 3, padding=1)
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

    def step(self, frame: Planes, state: State | None) -> tuple[Planes, State | None]:
        """One frame, planes (N, 1, H, W) and (N, 1, H/2, W/2), and the state after it."""
        rgb = None if self.config.colour == "planes" else self.to_rgb(*frame)
        features = self._features(frame, rgb)
        if self.lstm is not None:
            assert state is not None
            state = self.lstm(features, state)
            features = state.h + features if self.config.skip else state.h
        return self._picture(frame, rgb, features), state

    def forward(self, clip: Planes, state: State | None = None) -> tuple[Planes, State | None]:
        """A clip, planes (N, T, 1, H, W) and (N, T, 1, H/2, W/2): `step` over T, the parts without memory batched."""
        batch, steps, _, height, width = clip.y.shape
        frames = clip.flatten_time()
        rgb = None if self.config.colour == "planes" else self.to_rgb(*frames)
        features = self._features(frames, rgb)
        if self.lstm is not None:
            state = state or self.initial_state(batch, height, width)
            assert state is not None
            hidden = []
            for x in features.reshape(batch, steps, *features.shape[1:]).unbind(1):
                state = self.lstm(x, state)
                hidden.append(state.h)
            remembered = torch.stack(hidden, 1).flatten(0, 1)
            features = remembered + features if self.config.skip else remembered
        return self._picture(frames, rgb, features).unflatten_time(batch), state

    def _features(self, frame: Planes, rgb: Tensor | None) -> Tensor:
        s = self.config.unshuffle
        if rgb is None:
            x = torch.cat([F.pixel_unshuffle(p, b) for p, b in zip(frame, (s, s // 2, s // 2), strict=True)], 1)
            x = x / 255 - 0.5
        else:
            x = F.pixel_unshuffle(rgb - 0.5, s)
        x = F.relu(self.stem(INPUT_GAIN * x))
        total = x
        for block in self.blocks:
            x = block(x)
            total = total + x
        return total

    def _picture(self, frame: Planes, rgb: Tensor | None, features: Tensor) -> Planes:
        side = self.config.unshuffle * self.config.scale
        if rgb is None:
            n, m = side**2, (side // 2) ** 2
            base = torch.cat((self.luma_base(frame.y), self.chroma_base(frame.u), self.chroma_base(frame.v)), 1)
            # cells of bicubic code values plus the head's residual, still one pixel a channel
            y, u, v = (base + 255 * RESIDUAL_GAIN * self.head(features).to(base.dtype)).split((n, m, m), 1)
            return Planes(F.pixel_shuffle(y, side), F.pixel_shuffle(u, side // 2), F.pixel_shuffle(v, side // 2))
        residual = self.tail(F.pixel_shuffle(F.relu(self.head(features)), side))
        channels = rgb.flatten(0, 1).unsqueeze(1)
        base = F.pixel_shuffle(self.rgb_base(channels), side).reshape(residual.shape)
        return Planes(*self.to_planes(base + RESIDUAL_GAIN * residual.to(base.dtype)))


def parameter_count(network: nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())
