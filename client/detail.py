"""The network where the detail is, an interpolation everywhere else: a part of the time for most of what the network brings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.artifact import ModelSpec
from client.errors import ModelError
from client.frames import Frame, Plane
from client.tiles import Mask, TileGrid
from client.upscaler import OnnxUpscaler, State
from client.windows import run_windows, windowed_reach

# Luma pixels: smaller squares follow the detail better and cost more, halos included; docs/motion.md says how it was measured.
SQUARE = 64


class DetailState:
    """What a `DetailUpscaler` remembers of one stream; a value as `State` is one, consumed by the step that it is given to.

    `computed_share` is the share of squares that the step which returned it computed by the network, 0 to 1.
    """

    __slots__ = ("_parts", "computed_share", "height", "restarted", "width")

    def __init__(self, grid: TileGrid, state: State, base: State, restarted: bool, computed_share: float) -> None:
        self.height, self.width = state.height, state.width
        self.restarted = restarted
        self.computed_share = computed_share
        self._parts: tuple[TileGrid, State, State] | None = (grid, state, base)

    def _take(self) -> tuple[TileGrid, State, State]:
        if self._parts is None:
            raise ValueError("this state was consumed by an earlier step: pass on the one it returned")
        parts, self._parts = self._parts, None
        return parts


class DetailUpscaler:
    """An `OnnxUpscaler` that computes only the squares of a frame with most detail, and leaves the others to `base`.

    Detail is the gradient energy of the decoded luma; `share` of the squares, above 0 and below 1, are chosen in every frame, for that
    frame alone. They are joined into few windows, which may take in some more, and computed as in a whole frame; where that would
    cost nearly as much as the whole frame, all of it is computed. The state of a square that is left out stays as it was: computing it or
    zeroing it made no difference.

    Raises ModelError for models of two scales and for one that does not say how far it reaches, ProviderError for a runtime that
    compiles a model for every size anew, and ValueError for another share.
    """

    def __init__(self, upscaler: OnnxUpscaler, base: OnnxUpscaler, share: float) -> None:
        if not 0 < share < 1:
            raise ValueError(f"a share of {share} is not between 0 and 1")
        if base.spec.scale != upscaler.spec.scale:
            raise ModelError(f"{base.spec.name} upscales by {base.spec.scale}, {upscaler.spec.name} by {upscaler.spec.scale}")
        self.spec: ModelSpec = upscaler.spec
        self.provider, self.threads = upscaler.provider, upscaler.threads
        self._reach = windowed_reach(upscaler)
        self._upscaler, self._base = upscaler, base
        self._share = share

    def initial_state(self, height: int, width: int) -> DetailState:
        """An empty memory for frames of `height` x `width` pixels. Raises what `OnnxUpscaler` raises."""
        spec = self.spec
        state = self._upscaler.initial_state(height, width)
        state.tensors()  # refused here where they cannot be reached, not in the middle of a stream
        grid = TileGrid(spec.padded(height), spec.padded(width), spec.size_multiple, self._reach, SQUARE)
        return DetailState(grid, state, self._base.initial_state(height, width), restarted=False, computed_share=0.0)

    def step(self, frame: Frame, state: DetailState) -> tuple[Frame, DetailState]:
        """Upscale one frame, as `OnnxUpscaler.step` does and with what it raises."""
        if (frame.height, frame.width) != (state.height, state.width):
            raise ValueError(f"a {frame.width}x{frame.height} frame for a state of {state.width}x{state.height}")
        grid, memory, base = state._take()
        windows = grid.windows(most_detailed(frame.y, grid.tile, self._share))
        lost = False
        if windows is not None:
            picture, base = self._base.step(frame, base)
            if run_windows(self._upscaler, frame, windows, memory, picture):
                return picture, DetailState(grid, memory, base, False, float(grid.held(windows).mean()))
            lost, memory = True, self._upscaler.initial_state(frame.height, frame.width)  # lost in one place is lost
        picture, memory = self._upscaler.step(frame, memory)
        return picture, DetailState(grid, memory, base, lost or memory.restarted, 1.0)

    def warm_up(self, height: int, width: int) -> None:
        """Run a few grey frames, so that the first real one does not pay for allocation and first use."""
        self._upscaler.warm_up(height, width)
        self._base.warm_up(height, width)


def most_detailed(y: Plane, side: int, share: float) -> Mask:
    """Bool (rows, columns of squares of `side`): the `share` of them, at least one, with the greatest gradient energy a pixel."""
    energy = gradient_energy(y, side)
    chosen = np.zeros(energy.size, bool)
    chosen[np.argsort(-energy, axis=None, kind="stable")[: max(1, round(share * energy.size))]] = True
    return chosen.reshape(energy.shape)


def gradient_energy(y: Plane, side: int) -> NDArray[np.float64]:
    """The mean, over each square of `side` or what the plane has of it, of the squared differences to the next row and column."""
    down, across = np.zeros(y.shape, np.int16), np.zeros(y.shape, np.int16)
    np.subtract(y[1:], y[:-1], out=down[:-1], dtype=np.int16)
    np.subtract(y[:, 1:], y[:, :-1], out=across[:, :-1], dtype=np.int16)
    squares = np.square(down, dtype=np.int32) + np.square(across, dtype=np.int32)
    rows, columns = (np.arange(0, size, side) for size in y.shape)
    total = np.add.reduceat(np.add.reduceat(squares, rows, 0), columns, 1)  # below 2^31 up to squares of 128
    heights, widths = (np.diff(np.append(starts, size)) for starts, size in ((rows, y.shape[0]), (columns, y.shape[1])))
    return np.asarray(total / (heights[:, None] * widths))
