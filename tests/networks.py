"""Networks and clips for the tests: seeded, small, with every weight and bias away from zero."""

from __future__ import annotations

import torch

from model.catalogue import network_of_preset
from model.planes import Network, Planes


def random_network(preset: str, scale: int = 2, seed: int = 0) -> Network:
    torch.manual_seed(seed)
    network = network_of_preset(preset, scale)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network.eval()


def random_clip(batch: int, frames: int, height: int, width: int, seed: int = 1) -> Planes:
    """Random code values, float64."""
    generator = torch.Generator().manual_seed(seed)
    sizes = ((height, width), (height // 2, width // 2), (height // 2, width // 2))
    return Planes(*(torch.randint(0, 256, (batch, frames, 1, *size), generator=generator).double() for size in sizes))
