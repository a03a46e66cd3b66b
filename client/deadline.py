"""The deadline of a live frame: how long it lasts, and which frames are left out so that the newest is in time."""

from __future__ import annotations

from collections import deque
from fractions import Fraction

from client.frames import Frame

DEFAULT_PERIOD_NS = 1_000_000_000 // 60  # until two frames have told theirs
MAX_PERIOD_NS = 1_000_000_000
MOST_LEFT_OUT = 8  # in a row, at first: the picture moves even where decoding alone is almost too slow
RAREST = 64  # a second of frames, as many as a receiver's queue holds
_DIFFERENCES = 16


class FramePeriod:
    """How long a stream's frames last, from their timestamps: the median of the last 16 differences, so that lost frames do not count."""

    def __init__(self) -> None:
        self.ns = DEFAULT_PERIOD_NS
        self._last: Fraction | None = None
        self._differences: deque[int] = deque(maxlen=_DIFFERENCES)

    def add(self, frame: Frame) -> None:
        if frame.pts is None or frame.time_base is None:
            return
        now = frame.pts * frame.time_base
        if self._last is not None:
            difference_ns = int((now - self._last) * 1_000_000_000)
            if 0 < difference_ns < MAX_PERIOD_NS:
                self._differences.append(difference_ns)
                self.ns = sorted(self._differences)[len(self._differences) // 2]
        self._last = now


class DeadlineRule:
    """Whether a decoded frame is upscaled and shown, or left out because newer ones wait.

    With nothing newer it is always shown, late or not: late is better than never. Otherwise only if it and all that wait could still
    be presented within the deadline of this one, at the pace of late. After eight left out in a row one is shown all the same, the
    next after twice as many, up to 64, until nothing waits: else those that are shown would keep the others waiting.
    """

    def __init__(self) -> None:
        self._in_a_row, self._most = 0, MOST_LEFT_OUT

    def leaves_out(self, *, age_ns: int, waiting: int, frame_ns: int, deadline_ns: int) -> bool:
        """`age_ns` since its arrival, `waiting` newer ones, `frame_ns` for decoding, upscaling and presenting one."""
        if not waiting or age_ns + (1 + waiting) * frame_ns <= deadline_ns:
            self._in_a_row, self._most = 0, MOST_LEFT_OUT
            return False
        if not self._in_a_row:
            self._most = min(max(self._most, 2 * waiting), RAREST)
        self._in_a_row += 1
        if self._in_a_row <= self._most:
            return True
        self._in_a_row, self._most = 0, min(2 * self._most, RAREST)
        return False
