"""What every network here is: 4:2:0 planes in and out, with a state or without; training, export and verification need no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from model.reparam import fuse, load_fused

# Detail is a few hundredths of the code range: brought nearer to the unit scale of the layers, both ways, it trains faster.
INPUT_GAIN = 4.0
RESIDUAL_GAIN = 0.1


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


def to_planes(arrays: list[np.ndarray], device: torch.device) -> Planes:
    """uint8 arrays [y, u, v] as float planes of code values."""
    return Planes(*(torch.from_numpy(a).to(device, torch.float32) for a in arrays))


class State(NamedTuple):
    """The ConvLSTM's hidden and cell state, each (N, channels, H/unshuffle, W/unshuffle)."""

    h: Tensor
    c: Tensor


class LastLayer(NamedTuple):
    """The 3x3 convolutions between a network's features and its picture, in the form that runs.

    `module` takes the features in as its first channels. The first `features` inputs of `weights` are theirs, outputs over all tensors by
    plane, in cells of `sides`; what they and `biases` give is `gain` code values.
    """

    module: nn.Module
    features: int
    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    sides: tuple[int, ...]
    padding: int
    gain: float


class Network(nn.Module):
    """A network without memory, of which only `step` is missing; one with memory has its own `initial_state` and `forward` too.

    `scale` is the factor of upscaling, an input's height and width are multiples of `size_multiple`, and `description` is
    what builds the network again (`model.catalogue`), ready for JSON.
    """

    def __init__(self, scale: int, size_multiple: int, description: dict[str, Any]) -> None:
        super().__init__()
        self.scale, self.size_multiple, self.description = scale, size_multiple, description

    @property
    def weight(self) -> Tensor:
        """Any of the weights: its device and dtype are the network's."""
        return next(self.parameters())

    def initial_state(self, batch: int, height: int, width: int) -> State | None:
        """The state before the first of `batch` clips of the given size; None for a network without memory."""
        return None

    def step(
        self, frame: Planes, state: State | None, finish: Callable[[Tensor], Tensor] = lambda samples: samples
    ) -> tuple[Planes, State | None]:
        """One frame, planes (N, 1, H, W) and (N, 1, H/2, W/2), and the state after it.

        `finish` is applied to every sample of the picture where that costs least: before PixelShuffle moves them, if it can.
        """
        raise NotImplementedError

    def forward(self, clip: Planes, state: State | None = None) -> tuple[Planes, State | None]:
        """A clip, planes (N, T, 1, H, W) and (N, T, 1, H/2, W/2), all of its frames at once."""
        picture, _ = self.step(clip.flatten_time(), None)
        return picture.unflatten_time(clip.y.shape[0]), None

    def last_layer(self) -> LastLayer | None:
        """Of a network in the form that runs; None where what the features give is not the picture yet."""
        return None

    def deployed(self) -> Self:
        """The network in the form that runs, in place."""
        fuse(self)
        return self

    def load_deployed(self, deployed: Self) -> None:
        """Take the weights of the same network in the form that runs, to train on from: the way back from `deployed`."""
        load_fused(self, deployed)
