"""A frame that is the one before it once more is not computed: its picture is there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from client.artifact import ModelSpec
from client.frames import Frame, Plane
from client.upscaler import OnnxUpscaler, State


@dataclass(frozen=True, slots=True)
class Shown:
    """A decoded frame and the picture that was made of it; nobody writes to either."""

    decoded: Frame
    picture: Frame

    def __post_init__(self) -> None:
        for plane in (self.picture.y, self.picture.u, self.picture.v):
            plane.setflags(write=False)  # pictures to come may be the same arrays

    def again(self, frame: Frame) -> Frame | None:
        """The picture of `frame` where its samples are those of the one that was shown, else None."""
        before, picture = self.decoded, self.picture
        if not _same([(frame.y, before.y), (frame.u, before.u), (frame.v, before.v)]):
            return None
        return replace(frame, y=picture.y, u=picture.u, v=picture.v)


class RepeatState:
    """What a `RepeatUpscaler` remembers of one stream; a value as `State` is one, consumed by the step that it is given to.

    `computed_share` is 1 for a frame that was computed, 0 for one that was shown again.
    """

    __slots__ = ("_state", "computed_share", "height", "restarted", "shown", "width")

    def __init__(self, state: State, shown: Shown | None, restarted: bool, computed_share: float) -> None:
        self.height, self.width = state.height, state.width
        self.shown, self.restarted, self.computed_share = shown, restarted, computed_share
        self._state: State | None = state

    def _take(self) -> State:
        if self._state is None:
            raise ValueError("this state was consumed by an earlier step: pass on the one it returned")
        state, self._state = self._state, None
        return state


class RepeatUpscaler:
    """An `OnnxUpscaler` that shows the last picture again, its memory left as it is, for a frame equal to the one before."""

    def __init__(self, upscaler: OnnxUpscaler) -> None:
        self.spec: ModelSpec = upscaler.spec
        self.provider, self.threads = upscaler.provider, upscaler.threads
        self._upscaler = upscaler

    def initial_state(self, height: int, width: int) -> RepeatState:
        """An empty memory for frames of `height` x `width` pixels. Raises what `OnnxUpscaler` raises."""
        return RepeatState(self._upscaler.initial_state(height, width), None, restarted=False, computed_share=0.0)

    def step(self, frame: Frame, state: RepeatState) -> tuple[Frame, RepeatState]:
        """Upscale one frame, as `OnnxUpscaler.step` does and with what it raises.

        The frame is kept for the next step: neither it nor the picture is to be written to.
        """
        shown, memory = state.shown, state._take()
        if shown is not None and (picture := shown.again(frame)) is not None:
            return picture, RepeatState(memory, shown, restarted=False, computed_share=0.0)
        picture, memory = self._upscaler.step(frame, memory)
        return picture, RepeatState(memory, Shown(frame, picture), memory.restarted, computed_share=1.0)

    def warm_up(self, height: int, width: int) -> None:
        """Run a few grey frames, so that the first real one does not pay for allocation and first use."""
        self._upscaler.warm_up(height, width)


def _same(planes: list[tuple[Plane, Plane]]) -> bool:
    """In motion a sixteenth of the rows tells that they are not."""
    return all(np.array_equal(a[::16], b[::16]) for a, b in planes) and all(np.array_equal(a, b) for a, b in planes)
