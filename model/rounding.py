"""Training for 8 bits: what rounding the features that a head reads does to the picture is part of the error that is minimized."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor, nn

from client.errors import InputError
from client.frames import Frame
from model.calibration import MADE, MADE_FRAMES
from model.lean import Lean
from model.planes import Network, Planes

STEPS = 255  # from the smallest to the largest value of a channel


class RoundedFeatures:
    """What the last block of a `model.lean` network gives, rounded to 8 bits while it is trained.

    A channel's step follows from its range over the clip and over the made frames that calibration looks at too, and so does
    the gradient of the error: a network comes to give letters, lines and noise no larger features than footage (as in LSQ, Esser et al.
    2020, whose step is learned by itself). Where the codes lie is chance, new for each step; in a flat area a channel is off by the same
    everywhere, as it is when it runs, and noise that is new for every sample would not show what that does. Raises InputError for any
    other network.
    """

    def __init__(self, network: Network, seed: int) -> None:
        if not isinstance(network, Lean) or not network.blocks:
            raise InputError("only fast, live and balanced, wide or not, can be trained for 8 bits")
        self._network, self._last, self._seed = network, network.blocks[-1], seed
        made = [[_planes(frame, network.weight.device) for frame in make(width, height, MADE_FRAMES)] for make, width, height in MADE]
        self._made = list(zip(*made, strict=True))

    @contextmanager
    def __call__(self, index: int) -> Iterator[None]:
        """For the clips of step `index`, which says where the codes lie and which of the made frames tell the ranges."""
        seen: list[Tensor] = []
        hook = self._last.register_forward_hook(lambda module, inputs, features: seen.append(features))
        for frame in self._made[index % MADE_FRAMES]:
            self._network.step(frame, None)
        hook.remove()
        highest = torch.stack([features.amax((0, 2, 3)) for features in seen]).amax(0)
        lowest = torch.stack([features.amin((0, 2, 3)) for features in seen]).amin(0)
        chance = np.random.default_rng([self._seed, index]).random((len(highest), 1, 1), np.float32)  # a resumed run's is the same
        phases = torch.from_numpy(chance).to(highest.device)

        def rounded(module: nn.Module, inputs: object, features: Tensor) -> Tensor:
            width = torch.maximum(highest, features.amax((0, 2, 3))) - torch.minimum(lowest, features.amin((0, 2, 3)))
            step = (width / STEPS)[:, None, None]
            with torch.no_grad():
                codes = features.float() / step + phases  # bfloat16 holds 8 bits and no phase of them
                error = torch.where(step > 0, codes.round() - codes, 0)
            return features + error * step

        hook = self._last.register_forward_hook(rounded)
        try:
            yield
        finally:
            hook.remove()


def _planes(frame: Frame, device: torch.device) -> Planes:
    return Planes(*(torch.from_numpy(plane).to(device, torch.float32)[None, None] for plane in (frame.y, frame.u, frame.v)))
