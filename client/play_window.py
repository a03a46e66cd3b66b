"""The window as a player's sink: our picture, on the left of a wipe bicubic's, and lines that say how it goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from client.baselines import Baselines
from client.frames import Frame
from client.window import Action, Window

_LINES_NS = 500_000_000  # between two readings of the overlay


class WindowSink:
    """Presents pictures; `lines` says what the overlay shows, `follow` is told what the next picture is made of.

    Bicubic is computed only while the wipe is on, for the frame that is shown: it takes its time from that frame's.
    """

    def __init__(self, window: Window, lines: Callable[[], Sequence[str]], *, provider: str, threads: int | None) -> None:
        self._decoded: Frame | None = None
        self._window, self._lines = window, lines
        self._provider, self._threads = provider, threads
        self._overlay = self._wipe = False
        self._read: Sequence[str] = ()
        self._read_ns = 0
        self._baselines: dict[int, Baselines] = {}

    def follow(self, decoded: Frame) -> None:
        self._decoded = decoded

    def quits(self) -> bool:
        """Take what keys and mouse have done; whether the player is to end."""
        for action in self._window.actions():
            if action is Action.QUIT:
                return True
            if action is Action.OVERLAY:
                self._overlay = not self._overlay
                self._read_ns = 0
            elif action is Action.WIPE:
                self._wipe = not self._wipe
        return False

    def write(self, frame: Frame) -> None:
        left = None
        if self._wipe and self._decoded is not None:
            scale = round(frame.height / self._decoded.height)
            if scale not in self._baselines:
                self._baselines[scale] = Baselines(("bicubic",), scale, provider=self._provider, threads=self._threads)
            left = self._baselines[scale].upscale(self._decoded)["bicubic"]
        now_ns = time.perf_counter_ns()
        if self._overlay and now_ns - self._read_ns > _LINES_NS:
            self._read, self._read_ns = self._lines(), now_ns
        self._window.present(frame, left=left, overlay=self._read if self._overlay else ())
