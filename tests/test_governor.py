"""The governor on a simulated machine: what it may never do, and what it always does in time."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass, field

from hypothesis import given, settings
from hypothesis import strategies as st

from client.deadline import MOST_LEFT_OUT, DeadlineRule
from client.governor import HOLD_NS, MAX_HOLD_NS, MISSES_IN_A_ROW, Governor, Switch
from client.tiers import MOST_REPEATS

MS = 1_000_000
PERIOD_NS = 16_666_667
COSTS_NS = (9 * MS, 5 * MS, 2 * MS)  # the best first
OTHER_NS = 2 * MS  # decoding and presenting
SECOND = 60  # frames


@dataclass
class Machine:
    """A player of 60 frames a second in simulated time: one frame at a time, the deadline rule before the upscaler."""

    load: Callable[[int], float]  # of a frame's number: how many times slower than in warm-up everything is
    costs_ns: tuple[int, ...] = COSTS_NS
    deadline_ns: int = PERIOD_NS
    warm_up_ns: tuple[int, ...] | None = None  # what the governor is told that they cost, if it is not true
    jitter: float = 0.05
    seed: int = 1
    tiers: list[int] = field(default_factory=list)  # of each frame; -1 where it was left out
    latencies_ns: list[int] = field(default_factory=list)
    switches: list[Switch] = field(default_factory=list)

    def run(self, frames: int) -> Machine:
        governor = Governor(self.warm_up_ns or self.costs_ns, deadline_ns=self.deadline_ns, period_ns=PERIOD_NS, now_ns=0)
        rule, draw = DeadlineRule(), random.Random(self.seed)
        free_ns = 0
        for number in range(frames):
            arrival_ns = number * PERIOD_NS
            slower = self.load(number) * (1 + self.jitter * draw.random())
            decoded_ns = max(arrival_ns, free_ns) + int(OTHER_NS * slower)
            waiting = min(frames - 1, decoded_ns // PERIOD_NS) - number
            if rule.leaves_out(age_ns=decoded_ns - arrival_ns, waiting=waiting, frame_ns=governor.frame_ns, deadline_ns=self.deadline_ns):
                free_ns = decoded_ns
                self.tiers.append(-1)
                switch = governor.left_out(decoded_ns, waiting=waiting)
            else:
                upscale_ns = int(self.costs_ns[governor.tier] * slower)
                self.tiers.append(governor.tier)
                free_ns = decoded_ns + upscale_ns
                self.latencies_ns.append(free_ns - arrival_ns)
                busy_ns = upscale_ns + int(OTHER_NS * slower)
                switch = governor.shown(free_ns, latency_ns=free_ns - arrival_ns, busy_ns=busy_ns, upscale_ns=upscale_ns)
            if switch is not None:
                self.switches.append(switch)
        return self

    def kept(self) -> float:
        return sum(latency_ns <= self.deadline_ns for latency_ns in self.latencies_ns) / len(self.tiers)


def test_it_begins_with_the_best_that_fits() -> None:
    def begun(*costs_ns: int) -> int:
        return Governor(costs_ns, deadline_ns=PERIOD_NS, period_ns=PERIOD_NS, now_ns=0).tier

    assert begun(9 * MS, 5 * MS, 2 * MS) == 0
    assert begun(14 * MS, 5 * MS, 2 * MS) == 1
    assert begun(60 * MS, 30 * MS, 20 * MS) == 2  # nothing fits: the cheapest
    assert Governor((14 * MS, MS), deadline_ns=40 * MS, period_ns=PERIOD_NS, now_ns=0).tier == 1  # a late deadline makes no time


def test_a_machine_that_keeps_up_is_left_alone() -> None:
    machine = Machine(lambda _: 1.0).run(60 * SECOND)
    assert machine.switches == [] and machine.kept() == 1.0


def test_a_stolen_core_costs_few_deadlines_and_the_best_tier_comes_back() -> None:
    """Twice as slow for 20 of 60 s: 99 of 100 deadlines are kept, and the end is as the beginning."""
    machine = Machine(lambda number: 2.0 if 20 * SECOND <= number < 40 * SECOND else 1.0).run(60 * SECOND)
    assert machine.kept() >= 0.99
    assert machine.tiers[0] == machine.tiers[-1] == 0 and 0 not in machine.tiers[25 * SECOND : 39 * SECOND]
    assert len(machine.switches) <= 4


@settings(max_examples=20, deadline=None)
@given(
    live_ms=st.floats(8.0, 10.5),
    low=st.floats(1.7, 2.0),
    begin=st.integers(0, 30 * SECOND),
    lasts=st.integers(12, 60),
    seed=st.integers(0, 99),
)
def test_a_thief_of_a_core_costs_one_step_down_and_one_up(live_ms: float, low: float, begin: int, lasts: int, seed: int) -> None:
    """Tiers, deadline and thief as docs/play.md measures them: each frame takes twice as long, one more and one less."""
    end, draw = begin + lasts * SECOND, random.Random(seed)
    machine = Machine(
        lambda number: draw.uniform(low, low + 0.5) if begin <= number < end else 1.1,
        costs_ns=(int(live_ms * MS), 5 * MS),
        deadline_ns=2 * PERIOD_NS,
        seed=seed,
    ).run(end + 20 * SECOND)
    assert [(switch.before, switch.after) for switch in machine.switches] == [(0, 1), (1, 0)]
    down, up = (switch.at_ns // PERIOD_NS for switch in machine.switches)
    assert begin < down <= begin + SECOND and end <= up <= end + 3 * SECOND
    late = sum(latency_ns > machine.deadline_ns for latency_ns in machine.latencies_ns) + machine.tiers.count(-1)
    assert late <= 3 * MISSES_IN_A_ROW  # of 1,500 frames in 25 s: 99.4% kept


def test_keeping_pace_is_a_question_of_the_median() -> None:
    """Every twelfth frame takes longer: with two periods to be in time that is made good, and the better tier does not stay away."""
    machine = Machine(lambda n: 2.2 if n < 200 else 1.8 if n % 12 == 0 else 1.0, costs_ns=(11 * MS, 6 * MS), deadline_ns=2 * PERIOD_NS)
    machine.run(30 * SECOND)
    assert machine.tiers[150] == 1 and set(machine.tiers[12 * SECOND :]) == {0}


def test_a_tier_is_judged_by_what_it_showed_in_play_where_that_was_less_than_in_warm_up() -> None:
    """The better tier was warmed up beside the stream, which took a third of its time; by that it would not come back."""
    stolen = range(10 * SECOND, 20 * SECOND)
    true_ns, told_ns = (int(9.5 * MS), int(6.2 * MS)), (13 * MS, int(6.2 * MS))
    machine = Machine(lambda n: 2.0 if n in stolen else 1.05, costs_ns=true_ns, warm_up_ns=told_ns, deadline_ns=2 * PERIOD_NS)
    machine.run(30 * SECOND)
    assert machine.tiers[5 * SECOND] == 0 and 0 not in machine.tiers[11 * SECOND : 20 * SECOND]
    assert set(machine.tiers[23 * SECOND :]) == {0}


@settings(max_examples=40, deadline=None)
@given(slow=st.floats(2.0, 12.0), begin=st.integers(0, 200), seed=st.integers(0, 9))
def test_overload_is_answered_in_bounded_time(slow: float, begin: int, seed: int) -> None:
    """However bad it gets, after three frames that missed (or were left out) it is a tier lower."""
    machine = Machine(lambda number: slow if number >= begin else 1.0, seed=seed).run(begin + 60)
    late = [number for number in range(begin, begin + 60) if machine.tiers[number] == 0]
    assert len(late) <= MISSES_IN_A_ROW + 1
    if slow > 8:  # even the cheapest is too slow: it is what runs
        assert set(machine.tiers[begin + 3 * MISSES_IN_A_ROW + MOST_LEFT_OUT :]) <= {-1, 2}


@settings(max_examples=25, deadline=None)
@given(loads=st.lists(st.floats(0.5, 6.0), min_size=3, max_size=8), stays=st.integers(1, 300), seed=st.integers(0, 9))
def test_it_never_hunts(loads: list[float], stays: int, seed: int) -> None:
    """Whatever the load does: 2 s at least lie before every step up, and a tier that fails again and again is tried ever more rarely."""
    machine = Machine(lambda number: loads[number // stays % len(loads)], seed=seed).run(40 * SECOND)
    for before, after in itertools.pairwise(machine.switches):
        if after.after < after.before:
            assert after.at_ns - before.at_ns >= HOLD_NS
        assert before.after == after.before != after.after
    last_down: dict[int, int] = {}
    for switch in machine.switches:
        if switch.after > switch.before:
            last_down[switch.before] = switch.at_ns
        elif switch.after in last_down:
            assert switch.at_ns - last_down[switch.after] >= HOLD_NS


def test_a_tier_that_always_fails_is_tried_ever_more_rarely() -> None:
    """A load that only the best tier brings: nothing foretells it, so only the back-off keeps it from coming every two seconds."""
    governor = Governor(COSTS_NS, deadline_ns=PERIOD_NS, period_ns=PERIOD_NS, now_ns=0)
    ups, switch = [], None
    for number in range(600 * SECOND):
        now_ns = number * PERIOD_NS
        upscale_ns = 30 * MS if governor.tier == 0 else COSTS_NS[governor.tier]
        switch = governor.shown(now_ns, latency_ns=upscale_ns + MS, busy_ns=upscale_ns + MS, upscale_ns=upscale_ns)
        if switch is not None and switch.after == 0:
            ups.append(switch.at_ns)
    gaps = [b - a for a, b in itertools.pairwise(ups)]
    assert 5 <= len(ups) <= 15
    assert all(b >= min(1.9 * a, MAX_HOLD_NS) for a, b in itertools.pairwise(gaps))


def test_pictures_shown_again_tempt_nobody_upwards() -> None:
    """A menu for half a minute, of which a frame in ten is computed: what shows it is as fast as before, and what did not fit does not."""
    governor = Governor([2 * PERIOD_NS, *COSTS_NS[1:]], deadline_ns=PERIOD_NS, period_ns=PERIOD_NS, now_ns=0)
    tier, busy_ns = governor.tier, OTHER_NS + COSTS_NS[governor.tier]
    for number in range(40 * SECOND):
        again = 5 * SECOND < number < 35 * SECOND and number % 10 > 0
        upscale_ns = MS // 10 if again else COSTS_NS[tier]
        latency_ns = OTHER_NS + upscale_ns
        switch = governor.shown(number * PERIOD_NS, latency_ns=latency_ns, busy_ns=latency_ns, upscale_ns=upscale_ns, computed=not again)
        assert switch is None and (not number or governor.frame_ns == busy_ns)
    assert tier > 0


def test_the_best_tier_comes_back_in_a_pause_too() -> None:
    """Three frames missed, then a menu of which the tiers compute one frame in 16."""
    governor, number = Governor(COSTS_NS, deadline_ns=PERIOD_NS, period_ns=PERIOD_NS, now_ns=0), 0
    while governor.tier == 0:
        governor.shown(number * PERIOD_NS, latency_ns=2 * PERIOD_NS, busy_ns=2 * PERIOD_NS, upscale_ns=PERIOD_NS)
        number += 1
    while governor.tier > 0 and number < 40 * SECOND:
        again = number % (MOST_REPEATS + 1) > 0
        upscale_ns = 0 if again else COSTS_NS[governor.tier]
        latency_ns = OTHER_NS + upscale_ns
        governor.shown(number * PERIOD_NS, latency_ns=latency_ns, busy_ns=latency_ns, upscale_ns=upscale_ns, computed=not again)
        number += 1
    assert number < 17 * SECOND


@settings(max_examples=25, deadline=None)
@given(slow=st.floats(1.2, 8.0), lasts=st.integers(5, 20 * SECOND), seed=st.integers(0, 9))
def test_it_climbs_back_when_the_load_goes(slow: float, lasts: int, seed: int) -> None:
    machine = Machine(lambda number: slow if number < lasts else 1.0, seed=seed).run(lasts + (MAX_HOLD_NS // PERIOD_NS) + 10 * SECOND)
    assert machine.tiers[-1] == 0


@settings(max_examples=20, deadline=None)
@given(slow=st.floats(0.5, 20.0), jitter=st.floats(0, 1.0), seed=st.integers(0, 99))
def test_latency_never_grows(slow: float, jitter: float, seed: int) -> None:
    """Even where decoding is all that the machine can do: what it owes to shown frames it makes good before the next one is shown."""
    slow = min(slow, 0.95 * PERIOD_NS / OTHER_NS / (1 + jitter))
    machine = Machine(lambda _: slow, jitter=jitter, seed=seed).run(30 * SECOND)
    frame_ns = slow * (1 + jitter) * (COSTS_NS[2] + OTHER_NS)
    assert max(machine.latencies_ns[len(machine.latencies_ns) // 2 :]) <= (MOST_LEFT_OUT + 2) * (frame_ns + PERIOD_NS)


def test_a_tier_is_not_tried_that_the_measured_load_forbids() -> None:
    """Half as fast as in warm-up: the middle tier fits, the best would come to 18 ms, and is never tried."""
    machine = Machine(lambda _: 2.0, costs_ns=(9 * MS, 4 * MS, 2 * MS)).run(60 * SECOND)
    assert machine.tiers[5 * SECOND :].count(0) == 0 and set(machine.tiers[10 * SECOND :]) == {1}


def test_every_switch_has_its_reason() -> None:
    machine = Machine(lambda number: 10.0 if number > 30 else 1.0).run(60)
    assert machine.switches and all("frame" in switch.reason and switch.before != switch.after for switch in machine.switches)
    assert Machine(lambda _: 10.0, costs_ns=COSTS_NS[:1]).run(60).switches == []
