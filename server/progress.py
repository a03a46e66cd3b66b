"""A line on the terminal that says how far a sweep is: the reader of its events for people who wait."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self, TextIO

from client.progress import clock
from server.events import Event, LatencyDone, LatencyFailed, LatencyReused, PlanMade, PointDone, PointFailed, PointReused, Waiting


class SweepProgress:
    """Points done and time left, redrawn in place; silent where `stream` is not a terminal."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._begin = time.monotonic()
        self._points = self._latencies = self._computed = self._over = self._latencies_over = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._draw("")

    def show(self, event: Event) -> None:
        if isinstance(event, PlanMade):
            self._points, self._latencies = event.points, event.latencies
        elif isinstance(event, PointDone | PointFailed | PointReused):
            self._over += 1
            self._computed += not isinstance(event, PointReused)
        elif isinstance(event, LatencyDone | LatencyFailed | LatencyReused):
            self._latencies_over += 1
        self._draw(f"{self._line()}, waiting: {event.reason}" if isinstance(event, Waiting) else self._line())

    def _line(self) -> str:
        if self._over == self._points:
            return f"{self._points} points, {self._latencies_over}/{self._latencies} latencies"
        line = f"{self._over}/{self._points} points"
        if self._computed:
            each_s = (time.monotonic() - self._begin) / self._computed
            line += f", {clock(each_s * (self._points - self._over))} left"
        return line

    def _draw(self, line: str) -> None:
        if self._stream.isatty():
            self._stream.write(f"\r\x1b[K{line}")
            self._stream.flush()
