"""What a network costs wherever it runs: parameters, and multiply-accumulates of a frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.overrides import TorchFunctionMode

from model.planes import Network, Planes


def parameter_count(network: nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())


def macs(network: Network, height: int = 540, width: int = 960) -> int:
    """Multiply-accumulates of the convolutions with trained weights for one frame; a size is raised to the network's multiple.

    As papers count them: fixed interpolation, colour conversion, activations and norms are left out, taps on the padding
    are in. Nothing is computed: the frame is made of shapes alone.
    """
    height, width = (-(-side // network.size_multiple) * network.size_multiple for side in (height, width))
    counter = _MacCounter()
    with FakeTensorMode(allow_non_fake_inputs=True), counter:
        luma = torch.zeros(1, 1, height, width, dtype=network.weight.dtype)
        chroma = torch.zeros(1, 1, height // 2, width // 2, dtype=network.weight.dtype)
        network.step(Planes(luma, chroma, chroma), network.initial_state(1, height, width))
    return counter.macs


class _MacCounter(TorchFunctionMode):
    def __init__(self) -> None:
        super().__init__()
        self.macs = 0

    def __torch_function__(
        self, function: Callable[..., Any], types: Sequence[type], args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = function(*args, **(kwargs or {}))
        if function in (torch.conv2d, torch.conv_transpose2d):
            source, weight = args[:2]
            if weight.requires_grad:  # trained, or made of what is trained
                # every output sample takes one product a weight of its filter; transposed, every input sample gives them
                per_filter: Tensor = source if function is torch.conv_transpose2d else result
                self.macs += per_filter.numel() * weight[0].numel()
        return result
