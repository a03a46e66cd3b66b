"""How long after the packet before it a packet comes, by timestamps that may go back or leap."""

from __future__ import annotations

from fractions import Fraction

_LEAP_S = 1  # more is a gap in the recording, or the clock of another one behind it


def step_s(before: int | None, dts: int | None, time_base: Fraction, period_s: Fraction) -> Fraction:
    """Seconds from one packet's timestamp to the next one's; `period_s` where one has none, and where they go back or leap."""
    if before is None or dts is None:
        return period_s
    step = (dts - before) * time_base
    return step if 0 <= step <= _LEAP_S else period_s
