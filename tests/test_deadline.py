"""The deadline rule on a simulated machine, against what is said of it."""

from __future__ import annotations

import itertools

import pytest

from client.deadline import DeadlineRule

PERIOD = 1.0  # a frame's duration, which is the deadline too


def slowest(burst: int, decode: float, work: float) -> float:
    """The longest latency of a shown frame, in durations, where that many came at once and others follow one by one."""
    rule, arrivals = DeadlineRule(), [0.0] * burst + [PERIOD * (n + 1) for n in range(2 * burst + 20)]
    free = most = 0.0
    for number, arrived in enumerate(arrivals):
        free = max(arrived, free) + decode
        waiting = sum(other <= free for other in arrivals[number + 1 :])
        age_ns, frame_ns, deadline_ns = (round(taken * 1e9) for taken in (free - arrived, work, PERIOD))
        if not rule.leaves_out(age_ns=age_ns, waiting=waiting, frame_ns=frame_ns, deadline_ns=deadline_ns):
            free += work - decode
            most = max(most, free - arrived)
    return most


@pytest.mark.parametrize(("decode", "work"), list(itertools.product((0.05, 0.16, 0.3, 0.49), (0.5, 0.8, 0.99))))
def test_a_burst_makes_nothing_that_is_shown_later_than_the_deadline_and_one_frames_work(decode: float, work: float) -> None:
    assert max(slowest(burst, decode, work) for burst in (1, 2, 3, 5, 8, 13, 21, 32)) <= PERIOD + work + 1e-6


def test_a_larger_burst_than_that_does() -> None:
    assert slowest(60, 2.65 / 16.67, 16.53 / 16.67) * 16.67 == pytest.approx(103, abs=1)
