"""How far around itself a picture looks: measured on the module that is exported, not counted by hand.

A NaN goes through every convolution, activation and comparison, also where it is weighted by zero: what is not finite at the end is what
could depend on the place where it was put in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from model.planes import Network, Planes, State

MAX_CELLS = 32


def network_reach(network: Network) -> int | None:
    """The reach of one step of a network, from its frame and its state to its picture and its next state; see `reach`.

    The network is one in float64: in float32 a convolution may be computed in blocks, through which a NaN spreads.
    """

    def step(frame: Planes) -> Sequence[Tensor]:
        state = network.initial_state(1, *frame.y.shape[2:])
        if state is not None:  # a state of NaN in the cells where the frame is one
            divisor = frame.y.shape[2] // state.h.shape[2]
            lost = torch.isnan(frame.y[:, :, ::divisor, ::divisor])
            state = State(*(part.masked_fill(lost, torch.nan) for part in state))
        picture, after = network.step(frame, state)
        return [*picture, *(after or ())]

    return reach(step, network.size_multiple)


def reach(function: Callable[[Planes], Sequence[Tensor]], multiple: int) -> int | None:
    """How many luma pixels of the input, a multiple of `multiple`, what is computed of an area may lie outside that area.

    `function` takes float64 planes of 4:2:0 (1, 1, H, W) and (1, 1, H/2, W/2), H and W multiples of `multiple`, and gives tensors
    (1, C, h, w), each of them covering the whole frame. None where it is more than 32 cells of that size, or has no end.
    """
    side = (2 * MAX_CELLS + 3) * multiple
    frame = Planes(*(torch.full((1, 1, s, s), 100.0, dtype=torch.float64) for s in (side, side // 2, side // 2)))
    first = (MAX_CELLS + 1) * multiple
    for plane, divisor in zip(frame, (1, 2, 2), strict=True):
        plane[:, :, first // divisor : (first + multiple) // divisor, first // divisor : (first + multiple) // divisor] = torch.nan
    cells = 0
    with torch.no_grad():
        for output in function(frame):
            size = output.shape[2] // (2 * MAX_CELLS + 3)
            reached = torch.isnan(output).any(1).any(0).nonzero() // size - (MAX_CELLS + 1)
            cells = max(cells, int(reached.abs().max()))
    return None if cells > MAX_CELLS else cells * multiple
