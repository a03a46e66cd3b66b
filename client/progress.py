"""A line on the terminal that says how far a long run is."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self, TextIO

_INTERVAL_S = 0.2


class Progress:
    """Frames done, frames per second and time left, redrawn in place; silent where `stream` is not a terminal."""

    def __init__(self, stream: TextIO, total_frames: int | None) -> None:
        self._stream, self._total = stream, total_frames
        self._shown = stream.isatty()
        self._begin = self._next = time.monotonic()
        self._frames = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def advance(self) -> None:
        self._frames += 1
        now = time.monotonic()
        if not self._shown or now < self._next:
            return
        self._next = now + _INTERVAL_S
        fps = self._frames / max(now - self._begin, 1e-6)
        line = f"{self._frames} frames, {fps:.1f} frames/s"
        if self._total is not None and self._total > self._frames:
            line = f"{self._frames}/{self._total} frames, {fps:.1f} frames/s, {clock((self._total - self._frames) / fps)} left"
        self._stream.write(f"\r\x1b[K{line}")
        self._stream.flush()


def clock(seconds: float) -> str:
    """A duration as m:ss or h:mm:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
