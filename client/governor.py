"""Which tier computes the next frame: a rule over measured times, without a clock and without a thread of its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

START_SHARE = 0.8  # of the limit: what a tier may cost to be begun with, since decoding and presenting take their part
FIT_SHARE = 0.9  # of the deadline: what a better tier may come to, as far as can be told beforehand
PACE_SHARE = 0.95  # of a frame's period, in the median: a queue makes good for one frame what another took
SPREAD = 1.1  # a frame's p95 over its median, on a machine that does nothing else
WINDOW_FRAMES = 60
MIN_FRAMES = 20  # fewer have no 95th percentile
MISSES_IN_A_ROW = 3
MOST_MISSED, MISSES_FRAMES = 6, 600  # one of a hundred: as many as a stream may miss that keeps 99%
HOLD_NS = 2_000_000_000  # at least, between a switch and one upwards
LASTS_NS = 10_000_000_000  # a tier that holds so long was no mistake
MAX_HOLD_NS = 64_000_000_000


@dataclass(frozen=True, slots=True)
class Switch:
    """From one tier to another (the best is 0), when, and why."""

    at_ns: int
    before: int
    after: int
    reason: str


class Governor:
    """Moves between tiers, of which the first is the best, so that frames are presented within `deadline_ns` of their arrival.

    `costs_ns` are the least that each tier took for a frame in warm-up, at the stream's size; `deadline_ns` and `period_ns` may be set
    anew at any time. A tier is begun with only if its cost is at most 0.8 of the deadline and of a frame's period.

    Down it goes to the best tier that should fit, or to the last: when three frames in a row missed, when three wait, when the p95
    of the last 60 is over the deadline, or when six of the last 600 missed. Up it goes when none of 60 missed and the better tier should
    fit: its cost, times how much slower than in its own warm-up the present tier runs, and what the frame takes besides, come to
    at most 0.9 of the deadline in the 95th percentile and 0.95 of the period in the median. The cost is that of warm-up, or the least
    median of 60 frames that the tier has shown: warm-up has the stream beside it. From any switch to one upwards pass 2 s; a
    tier that does not last 10 s is next tried after twice as long as before, at most after 64 s.
    """

    def __init__(self, costs_ns: Sequence[int], *, deadline_ns: int, period_ns: int, now_ns: int) -> None:
        self.deadline_ns, self.period_ns = deadline_ns, period_ns
        self._costs_ns = costs_ns
        self._least_ns = list(costs_ns)
        self._in_a_row = 0
        self._hold_ns = [HOLD_NS] * len(costs_ns)
        self._not_before_ns = [now_ns + HOLD_NS] * len(costs_ns)
        fitting = [tier for tier, cost_ns in enumerate(costs_ns) if cost_ns <= START_SHARE * min(deadline_ns, period_ns)]
        self.tier = fitting[0] if fitting else len(costs_ns) - 1
        self._begin(now_ns)

    @property
    def frame_ns(self) -> int:
        """What decoding, upscaling and presenting take for a frame, of late; at first what upscaling took in warm-up."""
        if not self._upscale_ns:
            return self._costs_ns[self.tier]
        return _median(self._upscale_ns) + _median([busy_ns for _, busy_ns in self._besides_ns])

    def shown(self, now_ns: int, *, latency_ns: int, busy_ns: int, upscale_ns: int, computed: bool = True) -> Switch | None:
        """A frame was presented `latency_ns` after its arrival; decoding, upscaling and presenting took `busy_ns`, of it `upscale_ns`.

        One that was not `computed`, since its picture was there, counts as a frame, but says nothing of how fast the tier is.
        """
        self._latencies_ns.append(latency_ns)
        if computed:
            self._upscale_ns.append(upscale_ns)
            self._besides_ns.append((latency_ns - upscale_ns, busy_ns - upscale_ns))
        if len(self._upscale_ns) == WINDOW_FRAMES:
            self._least_ns[self.tier] = min(self._least_ns[self.tier], _median(self._upscale_ns))
        return self._count(now_ns, missed=latency_ns > self.deadline_ns) or self._up(now_ns)

    def left_out(self, now_ns: int, *, waiting: int) -> Switch | None:
        """A frame was not presented, since `waiting` newer ones were there."""
        self._latencies_ns.append(1 << 62)
        if waiting >= MISSES_IN_A_ROW:
            return self._down(now_ns, f"{waiting} frames waited")
        return self._count(now_ns, missed=True)

    def _count(self, now_ns: int, *, missed: bool) -> Switch | None:
        self._missed.append(missed)
        self._in_a_row = self._in_a_row + 1 if missed else 0
        if not missed:
            return None
        if self._in_a_row >= MISSES_IN_A_ROW:
            return self._down(now_ns, f"{self._in_a_row} frames in a row missed the deadline")
        if len(self._latencies_ns) >= MIN_FRAMES and _p95(self._latencies_ns) > self.deadline_ns:
            return self._down(now_ns, f"p95 of the last {len(self._latencies_ns)} frames was over the deadline")
        if sum(self._missed) >= MOST_MISSED:
            return self._down(now_ns, f"{sum(self._missed)} of the last {len(self._missed)} frames missed the deadline")
        return None

    def _down(self, now_ns: int, reason: str) -> Switch | None:
        if self.tier == len(self._costs_ns) - 1:
            return None
        if now_ns - self._since_ns < LASTS_NS:
            self._hold_ns[self.tier] = min(2 * self._hold_ns[self.tier], MAX_HOLD_NS)
        else:
            self._hold_ns[self.tier] = HOLD_NS
        self._not_before_ns[self.tier] = now_ns + self._hold_ns[self.tier]
        below = range(self.tier + 1, len(self._costs_ns))
        fitting = [tier for tier in below if self._fits(tier, 1.0, 1.0)] if self._upscale_ns else [self.tier + 1]
        return self._switch(now_ns, fitting[0] if fitting else below[-1], reason)

    def _up(self, now_ns: int) -> Switch | None:
        if self.tier == 0 or len(self._upscale_ns) < WINDOW_FRAMES or now_ns - self._since_ns < HOLD_NS:
            return None
        if any(latency_ns > self.deadline_ns for latency_ns in self._latencies_ns):
            return None
        for tier in range(self.tier):
            if now_ns >= self._not_before_ns[tier] and self._fits(tier, FIT_SHARE, PACE_SHARE):
                return self._switch(now_ns, tier, "the better tier fits the measured load")
        return None

    def _fits(self, tier: int, share: float, pace_share: float) -> bool:
        """Whether frames should be in time with a tier, and none wait for ever longer, as slow as the machine is now."""
        slower = _median(self._upscale_ns) / max(1, self._costs_ns[self.tier])
        cost_ns = self._least_ns[tier] * slower
        late_ns = SPREAD * cost_ns + _p95([before_ns for before_ns, _ in self._besides_ns])
        busy_ns = cost_ns + _median([busy_ns for _, busy_ns in self._besides_ns])
        return late_ns <= share * self.deadline_ns and busy_ns <= pace_share * self.period_ns

    def _switch(self, now_ns: int, tier: int, reason: str) -> Switch:
        switch = Switch(now_ns, self.tier, tier, reason)
        self.tier = tier
        self._begin(now_ns)
        return switch

    def _begin(self, now_ns: int) -> None:
        self._since_ns = now_ns
        self._in_a_row = 0
        self._latencies_ns: deque[int] = deque(maxlen=WINDOW_FRAMES)
        self._upscale_ns: deque[int] = deque(maxlen=WINDOW_FRAMES)
        self._besides_ns: deque[tuple[int, int]] = deque(maxlen=WINDOW_FRAMES)
        self._missed: deque[bool] = deque(maxlen=MISSES_FRAMES)


def _p95(values: Sequence[int] | deque[int]) -> int:
    """Nearest rank."""
    return sorted(values)[-(-95 * len(values) // 100) - 1]


def _median(values: Sequence[int] | deque[int]) -> int:
    return sorted(values)[len(values) // 2]
