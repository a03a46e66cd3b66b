"""Whether others want the processor too: a rule over times, and the system's own times."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client.cores import CoreTime, Crowding, core_time

SECOND_NS = 1_000_000_000


def crowding(threads: int, cores: int, seconds: Sequence[tuple[float, float]]) -> list[bool]:
    """What is said after seconds in which others and we computed on so many of the cores."""
    times = [CoreTime(0, 0, 0)]
    for others, own in seconds:
        before = times[-1]
        idle_ns = before.idle_ns + int((cores - others - own) * SECOND_NS)
        times.append(CoreTime(before.at_ns + SECOND_NS, idle_ns, before.own_ns + int(own * SECOND_NS)))
    look = iter(times)
    asked = Crowding(threads, lambda: next(look))
    return [asked.at(now.at_ns) for now in times[1:]]


@given(threads=st.integers(1, 64), spare=st.integers(0, 64), others=st.floats(0, 1), own=st.floats(0, 1))
def test_only_what_others_take_counts(threads: int, spare: int, others: float, own: float) -> None:
    cores = threads + spare
    of_others = others * cores
    if abs(cores - of_others - threads + 0.5) > 1e-6:
        assert crowding(threads, cores, [(of_others, own * (cores - of_others))]) == [of_others > spare + 0.5]


def test_it_is_of_the_last_second() -> None:
    assert crowding(2, 2, [(0.1, 1.0), (1.0, 0.6), (1.0, 1.0), (0.1, 0.6)]) == [False, True, True, False]


def test_it_is_looked_up_once_a_second() -> None:
    looks = iter([CoreTime(0, 0, 0), CoreTime(SECOND_NS, 0, 0)])
    asked = Crowding(2, lambda: next(looks))
    assert [asked.at(now_ns) for now_ns in (1, SECOND_NS - 1, SECOND_NS, SECOND_NS + 1, 2 * SECOND_NS - 1)] == [
        False,
        False,
        True,
        True,
        True,
    ]


def test_a_system_that_does_not_tell_is_never_crowded() -> None:
    asked = Crowding(2, lambda: None)
    assert not asked.at(0) and not asked.at(10 * SECOND_NS)


@pytest.mark.skipif(not Path("/proc/stat").exists(), reason="the system does not tell")
def test_the_systems_times() -> None:
    """Our own work is ours; no core is idle for longer than there was time. Nothing can be said of a machine that others use, too."""
    before = core_time()
    end = time.process_time() + 0.2
    while time.process_time() < end:
        pass
    after = core_time()
    assert before is not None and after is not None
    assert after.own_ns - before.own_ns >= 200_000_000
    assert after.idle_ns - before.idle_ns >= 0


@pytest.mark.skipif(not hasattr(__import__("os"), "sched_setaffinity"), reason="no affinity")
def test_a_core_that_another_process_has_is_seen() -> None:
    """On a core of our own choosing, together with one that computes: what is idle or ours is not the whole of it."""
    code = "import os, time; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); end = time.time() + 60\nwhile time.time() < end: pass"
    look = """
import os, time
from client.cores import Crowding
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
asked = Crowding(1)
time.sleep(1.5)
print(asked.at(time.perf_counter_ns()))
"""
    with subprocess.Popen([sys.executable, "-c", code]) as busy:
        try:
            assert subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout == "True\n"
        finally:
            busy.kill()
