"""The one way from a stream to upscaled pictures: the command line, a player, a sweep and a benchmark all drive it."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, TypeVar

from client.frames import Frame
from client.timing import Stamps
from client.video import Decoded


class StreamState(Protocol):
    """What an upscaler remembers of one stream: the size it was made for, and how the step that returned it went."""

    height: int
    width: int
    restarted: bool

    @property
    def computed_share(self) -> float: ...


AnyState = TypeVar("AnyState", bound=StreamState)


class Upscaler(Protocol[AnyState]):
    """What takes a stream's frames one after the other: `OnnxUpscaler`, or `SkippingUpscaler` around one."""

    def initial_state(self, height: int, width: int) -> AnyState: ...

    def step(self, frame: Frame, state: AnyState) -> tuple[Frame, AnyState]: ...


class Sink(Protocol):
    def write(self, frame: Frame) -> None:
        """Take one picture; whatever is kept of it is copied."""


class Restart(Enum):
    """Why the network's memory began anew at a frame."""

    SIZE = "the picture changed size"
    DAMAGE = "the stream was damaged until here"
    LOST = "the state was not finite"


@dataclass(frozen=True, slots=True)
class FrameDone:
    """One frame that went the whole way: as it was decoded, as it came out, when, and whether the state was restarted for it.

    `computed_share` is the share of its tiles that were computed, 1 where none is ever left out.
    """

    pts: int | None
    stamps: Stamps
    decoded: Frame
    picture: Frame
    restart: Restart | None
    computed_share: float


def upscale_stream(source: Iterable[Decoded], upscaler: Upscaler[AnyState], sink: Sink) -> Iterator[FrameDone]:
    """Upscale every frame of `source` in order into `sink`, one at a time, the state carried from frame to frame.

    The state starts from zeros with the stream, and again where the picture changes size, where damage ends, so that nothing of it
    reaches a clean picture, and where the state is lost. What the caller does between two frames is in no stage's time. Raises what
    source, upscaler and sink raise.
    """
    state: AnyState | None = None
    damaged = False
    for item in source:
        frame, restart = item.frame, None
        if state is None:
            state = upscaler.initial_state(frame.height, frame.width)
        elif (frame.height, frame.width) != (state.height, state.width):
            state, restart = upscaler.initial_state(frame.height, frame.width), Restart.SIZE
        elif damaged and not frame.damaged:
            state, restart = upscaler.initial_state(frame.height, frame.width), Restart.DAMAGE
        damaged = frame.damaged
        picture, state = upscaler.step(frame, state)
        upscaled_ns = time.perf_counter_ns()
        if state.restarted:
            restart = Restart.LOST
        sink.write(picture)
        stamps = Stamps(item.packet_ns, item.decoded_ns, upscaled_ns, time.perf_counter_ns())
        yield FrameDone(frame.pts, stamps, frame, picture, restart, state.computed_share)
