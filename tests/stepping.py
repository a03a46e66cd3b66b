"""Frames through an upscaler, by hand: alone, watched on their way through its session, and compared to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from client.frames import Frame
from client.upscaler import OnnxUpscaler, State


class Spy(OnnxUpscaler):
    """Writes down the size of every frame or window that goes through the session."""

    def __init__(self, model: Path) -> None:
        super().__init__(model, threads=1)
        self.sizes: list[tuple[int, int]] = []

    def step(self, frame: Frame, state: State) -> tuple[Frame, State]:
        self.sizes.append((frame.height, frame.width))
        return super().step(frame, state)

    def taken(self) -> list[tuple[int, int]]:
        """The sizes since this was last asked."""
        sizes, self.sizes = self.sizes, []
        return sizes


def whole(upscaler: OnnxUpscaler, frame: Frame) -> Frame:
    """The picture of all of the frame, from an empty state."""
    return upscaler.step(frame, upscaler.initial_state(frame.height, frame.width))[0]


def same(a: Frame, b: Frame) -> bool:
    return all(np.array_equal(p, q) for p, q in zip((a.y, a.u, a.v), (b.y, b.u, b.v), strict=True))
