"""The classical upscalers that a network is held against, run from the same decoded frames."""

from __future__ import annotations

from collections.abc import Sequence

from client.frames import Frame
from client.models import find_model
from client.upscaler import OnnxUpscaler, State


class Baselines:
    """Shipped baselines by name; raises ModelError for a name that does not ship."""

    def __init__(self, names: Sequence[str], scale: int, *, provider: str, threads: int | None) -> None:
        self._upscalers = {name: OnnxUpscaler(find_model(name, scale), provider=provider, threads=threads) for name in names}
        self._states: dict[str, State] = {}

    def upscale(self, frame: Frame) -> dict[str, Frame]:
        """Each baseline's picture of one frame."""
        pictures = {}
        for name, upscaler in self._upscalers.items():
            state = self._states.get(name)
            if state is None or (state.height, state.width) != (frame.height, frame.width):
                state = upscaler.initial_state(frame.height, frame.width)
            pictures[name], self._states[name] = upscaler.step(frame, state)
        return pictures
