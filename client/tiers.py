"""Several models as one upscaler of one stream, of which the one that a governor chose computes the next frame."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import numpy as np

from client.artifact import ModelSpec
from client.errors import GamesrError, ModelError
from client.frames import Frame, plane_shapes
from client.models import find_model
from client.repeats import Shown
from client.upscaler import OnnxUpscaler, State

TIMED_FRAMES = 5
MOST_REPEATS = 15  # by other tiers than the best: from what they compute a governor learns in a pause too that a better one fits
_PAUSE_S = 0.001


class TieredState:
    """What a `TieredUpscaler` hands from frame to frame; the memory itself is the upscaler's."""

    __slots__ = ("computed_share", "height", "restarted", "stream", "width")

    def __init__(self, height: int, width: int, stream: int, restarted: bool = False, computed_share: float = 0.0) -> None:
        self.height, self.width = height, width
        self.stream, self.restarted, self.computed_share = stream, restarted, computed_share


class TieredUpscaler:
    """Models by name, the best first, each made ready for the size of the stream; set `tier` to choose. A context manager.

    With the step after that, the chosen model's memory begins anew: no memory is used by another network, nor one that missed frames.
    A model without memory is not run for a frame equal to the one before, whose picture is shown again; but where it is not the
    best, for one in `MOST_REPEATS` + 1 of them.
    All buffers are made before a tier can be chosen (`prepare` waits for all of them), none by a switch. `display_height` chooses the
    scale, 2 or 3, that comes nearest to it; without, it is 2.
    It serves one stream at a time. Raises ModelError for what does not ship at the scale, and what `OnnxUpscaler` raises.
    """

    def __init__(self, names: Sequence[str], *, display_height: int | None, provider: str, threads: int | None) -> None:
        if not names:
            raise ValueError("there is no tier without a model")
        self.names, self.provider = list(names), provider
        self.tier = 0
        self.costs_ns: list[int] = []
        self.size: tuple[int, int] | None = None  # height and width that all is ready for
        self._display_height, self._threads = display_height, threads
        self._loaded: dict[int, list[OnnxUpscaler]] = {}
        self._states: dict[int, State] = {}
        self._shown: Shown | None = None  # by a model without memory
        self._repeats = 0
        self._running, self._stream = 0, 0
        self._preparation: _Preparation | None = None
        self.computing = threading.Lock()  # one model at a time: what plays must not slow down what is being timed
        self._upscalers = self._load(2)  # what is missing or does not start is said at once

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def specs(self) -> list[ModelSpec]:
        """Of the models in use, in the order of `names`."""
        return [upscaler.spec for upscaler in self._upscalers]

    @property
    def threads(self) -> int:
        return self._upscalers[0].threads

    def scale(self, height: int) -> int:
        """2 or 3, for pictures of this height."""
        display_height = self._display_height or 2 * height
        return min((2, 3), key=lambda scale: abs(scale * height - display_height))

    def ready(self, height: int, width: int) -> bool:
        """Whether pictures of this size can be upscaled, with the last tier at least; the first question about a size begins that.

        It runs in a thread, from the last tier to the first, so that decoding goes on. Raises what it raised, and ModelError for anything
        that is no GamesrError.
        """
        if self._preparation is not None and self._preparation.size != (height, width):
            self.close()  # one at a time: a stream cannot have more made by changing faster
        if self.size == (height, width):
            return True
        if self._preparation is None:
            self._preparation = _Preparation(self, height, width)
            self._preparation.start()
        preparation = self._preparation
        if not preparation.usable.is_set():
            preparation.check()
            return False
        self._upscalers, self._states, self.costs_ns = preparation.upscalers, preparation.states, preparation.costs_ns
        self.size, self.tier = (height, width), len(self.names) - 1
        return True

    @property
    def complete(self) -> bool:
        """Whether every tier can be chosen, and has been timed; until then it is the last one. Raises as `ready` does."""
        if self._preparation is not None and not self._preparation.is_alive():
            self._preparation.check()
            self._preparation = None
        return self._preparation is None

    def prepare(self, height: int, width: int) -> None:
        """Wait until all is ready."""
        while not self.ready(height, width) or not self.complete:
            time.sleep(0.01)

    def close(self) -> None:
        """Wait for the thread, which ends with the frame that it is at; a size of which only some tiers are ready is begun anew."""
        if self._preparation is not None:
            self._preparation.stop.set()
            self._preparation.join()
            if self._preparation.size == self.size:
                self.size = None
            self._preparation = None

    def initial_state(self, height: int, width: int) -> TieredState:
        """An empty memory; one that was given before is worth nothing any more."""
        while not self.ready(height, width):
            time.sleep(0.01)
        self._stream += 1
        self._begin_again()
        return TieredState(height, width, self._stream)

    def step(self, frame: Frame, state: TieredState) -> tuple[Frame, TieredState]:
        """Upscale one frame with the chosen tier.

        The frame is kept for the next step: neither it nor the picture is to be written to. Raises ValueError for a state of another
        stream and for a tier that is not there, or not ready yet (`complete`).
        """
        if state.stream != self._stream:
            raise ValueError("this state is of a stream that was begun anew since")
        if self.tier not in self._states:
            raise ValueError(f"tier {self.tier} of {', '.join(self.names)} is not there, or not ready yet")
        if self.tier != self._running:
            self._begin_again()
        if self._shown and (not self._running or self._repeats < MOST_REPEATS) and (again := self._shown.again(frame)):
            self._repeats += 1
            return again, TieredState(state.height, state.width, state.stream)
        self._repeats = 0
        upscaler = self._upscalers[self._running]
        with self.computing:
            picture, after = upscaler.step(frame, self._states[self._running])
        self._states[self._running] = after
        self._shown = None if upscaler.spec.state else Shown(frame, picture)
        return picture, TieredState(state.height, state.width, state.stream, after.restarted, computed_share=1.0)

    def _begin_again(self) -> None:
        self._running, self._shown = self.tier, None
        self._states[self._running] = self._upscalers[self._running].begin_again(self._states[self._running])

    def _load(self, scale: int) -> list[OnnxUpscaler]:
        if scale not in self._loaded:
            paths = [find_model(name, scale) for name in self.names]
            upscalers = [OnnxUpscaler(path, provider=self.provider, threads=self._threads) for path in paths]
            if len({upscaler.spec.scale for upscaler in upscalers}) > 1:
                raise ModelError(f"{' and '.join(self.names)} are of different scales: tiers take each other's place")
            self._loaded[scale] = upscalers
        return self._loaded[scale]


class _Stopped(Exception):
    """Another size is wanted by now."""


class _Preparation(threading.Thread):
    """Makes each tier's buffers for a size, has it run and times it; the lists are filled as it goes."""

    def __init__(self, tiers: TieredUpscaler, height: int, width: int) -> None:
        super().__init__(name="tiers", daemon=True)
        self.size = height, width
        self.stop = threading.Event()
        self.usable = threading.Event()
        self.upscalers: list[OnnxUpscaler] = []
        self.states: dict[int, State] = {}
        self.costs_ns = [0] * len(tiers.names)
        self._error: GamesrError | None = None
        self._tiers = tiers

    def run(self) -> None:
        try:
            self.upscalers = self._tiers._load(self._tiers.scale(self.size[0]))
            for tier in reversed(range(len(self.upscalers))):
                self.states[tier], self.costs_ns[tier] = self._timed(self.upscalers[tier])
                self.usable.set()
        except _Stopped:
            pass
        except GamesrError as error:
            self._error = error
        except Exception as error:  # the stream waits for this thread: whatever ends it is said there
            height, width = self.size
            self._error = ModelError(f"the models could not be made ready for {width}x{height}: {str(error) or type(error).__name__}")
            self._error.__cause__ = error

    def _timed(self, upscaler: OnnxUpscaler) -> tuple[State, int]:
        """The buffers that frames are computed in, and the least time that one took; raises _Stopped.

        Before each the lock is left alone for a moment: who waits for it wakes up more slowly than this thread takes it again.
        """
        state = upscaler.initial_state(*self.size)
        grey = [np.full(shape, 128, np.uint8) for shape in plane_shapes(*self.size)]
        frame = Frame(grey[0], grey[1], grey[2])
        durations_ns = []
        for _ in range(2 + TIMED_FRAMES):  # both bindings have run before anything counts
            if self.stop.wait(_PAUSE_S):
                raise _Stopped
            with self._tiers.computing:
                begin_ns = time.perf_counter_ns()
                _, state = upscaler.step(frame, state)
                durations_ns.append(time.perf_counter_ns() - begin_ns)
        return state, min(durations_ns[2:])

    def check(self) -> None:
        if self._error is not None:
            raise self._error
