"""Only what changed is computed: a tile whose input stays as it was keeps its picture and its state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from client.artifact import ModelSpec
from client.frames import Frame, plane_shapes
from client.pipeline import Upscaler
from client.repeats import RepeatUpscaler
from client.tiles import Mask, TileGrid, Window
from client.upscaler import OnnxUpscaler, State, copy_padded
from client.windows import can_run_windows, run_windows, windowed_reach

# Frames for which a recurrent network goes on with a tile that has stopped changing; docs/skipping.md says how it was measured.
SETTLING_FRAMES = 8


class SkippingState:
    """What a `SkippingUpscaler` remembers of one stream; a value as `State` is one, consumed by the step that it is given to.

    `computed_share` is the share of tiles that the step which returned it computed, 0 to 1.
    """

    __slots__ = ("_memory", "computed_share", "height", "restarted", "width")

    def __init__(self, memory: _Memory, restarted: bool, computed_share: float) -> None:
        self.height, self.width = memory.state.height, memory.state.width
        self.restarted = restarted
        self.computed_share = computed_share
        self._memory: _Memory | None = memory

    def copy(self) -> SkippingState:
        """A state of its own with the same content, that outlives the step which consumes this one."""
        return SkippingState(self._checked().copy(), self.restarted, self.computed_share)

    def _take(self) -> _Memory:
        memory = self._checked()
        self._memory = None
        return memory

    def _checked(self) -> _Memory:
        if self._memory is None:
            raise ValueError("this state was consumed by an earlier step: pass on the one it returned, or keep a copy()")
        return self._memory


class SkippingUpscaler:
    """An `OnnxUpscaler` that leaves out the tiles whose input is what they were last computed from.

    A frame equal to the one before it is not computed at all. Of any other frame a tile is left out when its input, as far as the
    model reaches around it, has not changed since it was computed: once where the model has no state, which is exact; in
    `settling_frames` frames where it has one, whose state then stays as it is, which comes near (a state looks further around with
    every frame). Where most of a frame changed, all of it is computed, in one run.

    Raises ValueError for fewer than one of `settling_frames`, ModelError for a model that does not say how far it reaches, and
    ProviderError for a runtime that compiles a model for every size anew: windows are of many.
    """

    def __init__(self, upscaler: OnnxUpscaler, *, settling_frames: int = SETTLING_FRAMES) -> None:
        if settling_frames < 1:
            raise ValueError(f"settling_frames is {settling_frames}, not 1 or more: a tile that is never computed never changes")
        self._reach = windowed_reach(upscaler)
        self.spec: ModelSpec = upscaler.spec
        self.provider, self.threads = upscaler.provider, upscaler.threads
        self._upscaler = upscaler
        self._settling_frames = settling_frames if upscaler.spec.state else 1

    def initial_state(self, height: int, width: int) -> SkippingState:
        """An empty memory for frames of `height` x `width` pixels: the first one is computed whole. Raises what `OnnxUpscaler` raises."""
        spec = self.spec
        state = self._upscaler.initial_state(height, width)
        state.tensors()  # refused here where they cannot be reached, not in the middle of a stream
        grid = TileGrid(spec.padded(height), spec.padded(width), spec.size_multiple, self._reach)
        return SkippingState(_Memory(grid, state), restarted=False, computed_share=0.0)

    def step(self, frame: Frame, state: SkippingState) -> tuple[Frame, SkippingState]:
        """Upscale one frame, as `OnnxUpscaler.step` does and with what it raises.

        The frame is kept for the next step: neither it nor the picture is to be written to.
        """
        if (frame.height, frame.width) != (state.height, state.width):
            raise ValueError(f"a {frame.width}x{frame.height} frame for a state of {state.width}x{state.height}")
        memory = state._take()
        last = memory.picture
        changed = memory.load(frame)
        if last is None:
            return self._whole(frame, memory)
        if not changed.any():
            return self._next(replace(frame, y=last.y, u=last.u, v=last.v), memory, 0.0, False)
        windows = memory.grid.windows(memory.ages < self._settling_frames)
        if windows is None:
            return self._whole(frame, memory)
        return self._windows(frame, last, memory, windows)

    def warm_up(self, height: int, width: int) -> None:
        """Run a few grey frames, so that the first real one does not pay for allocation and first use."""
        self._upscaler.warm_up(height, width)

    def _whole(self, frame: Frame, memory: _Memory, *, restarted: bool = False) -> tuple[Frame, SkippingState]:
        picture, memory.state = self._upscaler.step(frame, memory.state)
        restarted = restarted or memory.state.restarted
        memory.count(slice(None), begin_anew=restarted)
        return self._next(picture, memory, 1.0, restarted)

    def _windows(self, frame: Frame, last: Frame, memory: _Memory, windows: list[Window]) -> tuple[Frame, SkippingState]:
        picture = replace(frame, y=last.y.copy(), u=last.u.copy(), v=last.v.copy())
        if not run_windows(self._upscaler, frame, windows, memory.state, picture):  # lost in one place is lost
            memory.state = self._upscaler.initial_state(frame.height, frame.width)
            return self._whole(frame, memory, restarted=True)
        computed = memory.grid.held(windows)
        memory.count(computed)
        return self._next(picture, memory, float(computed.mean()), False)

    def _next(self, picture: Frame, memory: _Memory, share: float, restarted: bool) -> tuple[Frame, SkippingState]:
        for plane in (picture.y, picture.u, picture.v):
            plane.setflags(write=False)  # the next picture may show the same arrays
        memory.picture = picture
        return picture, SkippingState(memory, restarted, share)


def skipping_upscaler(upscaler: OnnxUpscaler) -> Upscaler[Any]:
    """What leaves out as much as the runtime lets it: unchanged tiles, or, where it cannot run windows, frames that come again."""
    return SkippingUpscaler(upscaler) if can_run_windows(upscaler) else RepeatUpscaler(upscaler)


class _Memory:
    """One stream: the last decoded frame, nobody writes to it, the last picture, and the tiles' ages.

    `ages` holds, for each tile, in how many frames it was computed from the input that it has, at least; up to 255. In a frame in
    motion every tile counts as changed, also one that was not looked at.
    """

    def __init__(self, grid: TileGrid, state: State) -> None:
        self.grid, self.state = grid, state
        self.picture: Frame | None = None
        self.ages = np.zeros(grid.shape, np.uint8)
        self._decoded: Frame | None = None
        self._padded: Frame | None = None  # the one that `_after` holds
        # What no frame covers stays zero, and so never differs.
        self._before, self._after = ([np.zeros(shape, np.uint8) for shape in grid.plane_shapes()] for _ in range(2))

    def load(self, frame: Frame) -> Mask:
        """Take a frame; gives the tiles whose input, with the halo, differs from the last one, or all where most of them do."""
        before, self._decoded = self._decoded, frame
        if before is None or self.grid.is_in_motion(before.y, frame.y):
            changed, self._padded = np.ones(self.grid.shape, bool), None
        else:
            if self._padded is not before:
                self._pad(before)
            self._before, self._after = self._after, self._before
            self._pad(frame)
            changed = self.grid.changed(self._before, self._after)
        self.ages[changed] = 0
        return changed

    def _pad(self, frame: Frame) -> None:
        """Into `_after`, as the model's input is."""
        shapes = plane_shapes(self.grid.height, self.grid.width)
        for plane, target, (height, width) in zip((frame.y, frame.u, frame.v), self._after, shapes, strict=True):
            copy_padded(plane, target[:height, :width])
        self._padded = frame

    def count(self, computed: Mask | slice, *, begin_anew: bool = False) -> None:
        if begin_anew:
            self.ages[:] = 0
        self.ages[computed] += self.ages[computed] < 255

    def copy(self) -> _Memory:
        twin = _Memory(self.grid, self.state.copy())
        twin.picture, twin.ages, twin._decoded = self.picture, self.ages.copy(), self._decoded
        return twin
