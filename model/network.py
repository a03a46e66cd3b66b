"""GameSR: a recurrent super-resolution network over decoded 4:2:0 frames, one module for a frame and for a clip.

The configuration `paper` is the network of the GameSR paper (figure 2, sections 3.2 and A.2); `planes` is ours: the same
blocks between the decoder's own Y, U and V planes, without any colour conversion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.colour import PlanesToRgb, RgbToPlanes
from model.interpolation import MIDDLES, Interpolation, LearnedInterpolation, chroma_shift, shuffle_channels_last
from model.planes import INPUT_GAIN, RESIDUAL_GAIN, LastLayer, Network, Planes, State
from model.reparam import LinearTriple

CELL_BOUND = 32.0  # tanh is 1 to float32's last bit from 9 on; 32 frames from zeros cannot reach it


@dataclass(frozen=True)
class NetworkConfig:
    """Everything that decides a network's shape.

    `unshuffle` is PixelUnshuffle's factor (1: none); an input's height and width are multiples of `size_multiple`.
    `learned_base` lets training bend the bicubic kernel under the residual, `skip` adds the ConvLSTM's input to its
    output, so that detail need not pass through gates that saturate, and `norm` "static" leaves LayerNorm's statistics out
    (`StaticNorm`); all three are ours, not the paper's.
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
    norm: Literal["layer", "static"] = "layer"

    def __post_init__(self) -> None:
        if self.colour not in ("planes", "rgb"):
            raise ValueError(f"a network is of planes or of rgb, not of {self.colour}")
        if self.colour == "planes" and self.unshuffle % 2:
            raise ValueError("a planes network needs an even unshuffle, which brings luma to the size of chroma")
        if self.norm not in ("layer", "static"):
            raise ValueError(f"a norm is layer or static, not {self.norm}")

    @property
    def size_multiple(self) -> int:
        return max(2, self.unshuffle)


PRESETS: dict[str, dict[str, object]] = {
    "planes": {"learned_base": True, "skip": True},
    "planes-no-lstm": {"learned_base": True, "recurrent": False},
    "planes-static": {"learned_base": True, "skip": True, "norm": "static"},
    "planes-static-no-lstm": {"learned_base": True, "recurrent": False, "norm": "static"},
    "planes-plain": {},
    "paper": {"colour": "rgb"},
    "paper-no-lstm": {"colour": "rgb", "recurrent": False},
    "paper-no-unshuffle": {"colour": "rgb", "unshuffle": 1},
}


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of (N, C, H, W)."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class StaticNorm(nn.Module):
    """A gain and an offset a channel, (N, C, H, W): what is left of a norm whose statistics are the same everywhere.

    A runtime does it while it writes the convolution's result; LayerNorm takes passes of its own, a sixth to a third of a frame's time.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels, 1, 1))
        self.bias = nn.Parameter(torch.zeros(channels, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.weight + self.bias


class FeatureBlock(nn.Module):
    """FEB: a linear triple, GELU, residual, LayerNorm over channels (section 3.2; the order is that of section A.2)."""

    def __init__(self, channels: int, expanded: int, norm: Literal["layer", "static"]) -> None:
        super().__init__()
        # Without a norm nothing else keeps the signal in bounds at first.
        self.conv: nn.Module = LinearTriple(channels, expanded, nothing=norm == "static")
        self.norm = ChannelNorm(channels) if norm == "layer" else StaticNorm(channels)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.norm(x + F.gelu(self.conv(x)))
        return out


class ConvLstm(nn.Module):
    """A ConvLSTM cell whose four gates are one convolution over [x, h] (Shi et al. 2015, eq. 3, without peepholes).

    Ours is that no cell goes beyond CELL_BOUND: one that is never told to forget grows by up to 1 a frame, for as long as the stream runs.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1)
        with torch.no_grad():
            assert self.gates.bias is not None
            self.gates.bias[channels : 2 * channels] = 1.0  # the forget gate starts open (Jozefowicz et al. 2015)

    def forward(self, x: Tensor, state: State) -> State:
        i, f, o, g = self.gates(torch.cat((x, state.h), 1)).chunk(4, 1)
        c = torch.sigmoid(f) * state.c + torch.sigmoid(i) * torch.tanh(g)
        c = c.clamp(-CELL_BOUND, CELL_BOUND) + 0 * c  # a clamp alone hides NaN and Inf, which the client must see
        return State(torch.sigmoid(o) * torch.tanh(c), c)


class GameSR(Network):
    """The network of a `NetworkConfig`: `step` takes a frame and a state, `forward` a clip; both are the same graph.

    Pictures go in and come out as `Planes` of float code values; the output is neither rounded nor clamped. The head's
    (or tail's) last convolution starts at zero, so an untrained network is bicubic interpolation.
    """

    middles: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config.scale, config.size_multiple, asdict(config))
        self.config = config
        c, s, r = config.channels, config.unshuffle, config.scale
        side = s * r
        if config.colour == "planes":
            inputs, outputs = s * s + 2 * (s // 2) ** 2, side**2 + 2 * (side // 2) ** 2
            samples = torch.tensor([side**2, (side // 2) ** 2, (side // 2) ** 2])
            self.register_buffer("middles", torch.tensor(MIDDLES).repeat_interleave(samples).view(1, -1, 1, 1), persistent=False)
            self.luma_base = self._base(s, 0.0)
            self.chroma_base = self._base(s // 2, chroma_shift(r))
        else:
            inputs, outputs = 3 * s * s, 3 * side**2
            self.to_rgb, self.to_planes = PlanesToRgb(), RgbToPlanes()
            self.rgb_base = Interpolation("bicubic", r, s)
            self.tail = nn.Conv2d(3, 3, 3, padding=1)
        self.stem = nn.Conv2d(inputs, c, 3, padding=1)
        self.blocks = nn.ModuleList(FeatureBlock(c, config.expanded, config.norm) for _ in range(config.blocks))
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

    def last_layer(self) -> LastLayer | None:
        if self.config.colour == "rgb":
            return None
        side = self.config.unshuffle * self.config.scale
        assert self.head.bias is not None
        sides = (side, side // 2, side // 2)
        return LastLayer(
            self.head, self.config.channels, (self.head.weight,), (self.head.bias,), sides, padding=1, gain=255 * RESIDUAL_GAIN
        )

    def _base(self, block: int, shift: float) -> Interpolation:
        scale = self.config.scale
        if not self.config.learned_base:
            return Interpolation("bicubic", scale, block, shift)
        return LearnedInterpolation("bicubic", scale, block, shift)

    def _source(self, frame: Planes) -> Tensor:
        """What the layers see: the planes' cells around zero, or RGB."""
        if self.config.colour == "rgb":
            rgb: Tensor = self.to_rgb(*frame)
            return rgb
        s = self.config.unshuffle
        blocks = (s, s // 2, s // 2)
        cells = torch.cat([F.pixel_unshuffle(plane, b) for plane, b in zip(frame, blocks, strict=True)], 1)
        return cells / 255 - 0.5

    def _features(self, source: Tensor) -> Tensor:
        if self.config.colour == "rgb":
            x = self.stem(INPUT_GAIN * F.pixel_unshuffle(source - 0.5, self.config.unshuffle))
        else:
            x = self.stem(INPUT_GAIN * source)
        total = x = F.relu(x)
        for block in self.blocks:
            x = block(x)
            total = total + x
        return total

    def _picture(self, frame: Planes, source: Tensor, features: Tensor, finish: Callable[[Tensor], Tensor]) -> Planes:
        side = self.config.unshuffle * self.config.scale
        if self.config.colour == "rgb":
            residual = self.tail(F.pixel_shuffle(F.relu(self.head(features)), side))
            channels = source.flatten(0, 1).unsqueeze(1)
            base = F.pixel_shuffle(self.rgb_base(channels), side).reshape(residual.shape)
            return Planes(*(finish(p) for p in self.to_planes(base + RESIDUAL_GAIN * residual.to(base.dtype))))
        # cells of bicubic code values plus the head's residual, still one pixel a channel
        bases = (self.luma_base, self.chroma_base, self.chroma_base)
        base = torch.cat([base(plane - middle) for base, plane, middle in zip(bases, frame, MIDDLES, strict=True)], 1)
        cells = base + (255 * RESIDUAL_GAIN * self.head(features).to(base.dtype) + self.middles)
        n, m = side**2, (side // 2) ** 2
        parts = zip(torch.split(finish(cells), [n, m, m], 1), (side, side // 2, side // 2), strict=True)
        return Planes(*(shuffle_channels_last(part, block) for part, block in parts))
