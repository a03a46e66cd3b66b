"""What a player counts and times, in memory that does not grow."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from client.governor import Switch
from client.pipeline import FrameDone
from client.play_source import Arrived
from client.timing import LatencySummary, Stamps

KEPT_FRAMES = 1 << 16  # 18 minutes at 60 fps
FREEZE_PERIODS = 3
_KEPT_SWITCHES = 100
_FIRST, _LAST, _READY, _PACKET, _DECODED, _UPSCALED, _PRESENTED, _SENT, _TIER, _SIZE, _COMPUTED = range(11)
_STAGES = {
    "receive": (_FIRST, _LAST),  # the network's own
    "assemble": (_LAST, _READY),
    "queue": (_READY, _PACKET),
    "decode": (_PACKET, _DECODED),
    "upscale": (_COMPUTED, _UPSCALED),  # of what was: a picture shown again takes no model's time
    "present": (_UPSCALED, _PRESENTED),
    "total": (_LAST, _PRESENTED),
    "sent": (_SENT, _PRESENTED),
}
_OF_THE_NETWORK = ("receive", "assemble", "sent")


@dataclass
class PlayTally:
    """Counts of frames, and the stamps of the last 65,536 that were shown.

    `late` are shown frames that missed their deadline, `left_out` those that were not shown so that newer ones were in time,
    `unready` those that came while the tiers were made ready: the last tier showed them, if any did; nothing else counts them.
    `repeated` are shown frames that were the one before once more, and so were not computed.
    A freeze is a gap of more than three periods between two pictures, whoever showed them, from the first shown frame on.
    """

    shown: int = 0
    late: int = 0
    left_out: int = 0
    unready: int = 0
    damaged: int = 0
    repeated: int = 0
    freezes: int = 0
    longest_gap_ns: int = 0
    restarts: Counter[str] = field(default_factory=Counter)  # by reason
    tier_frames: Counter[str] = field(default_factory=Counter)  # by name
    switched: int = 0
    switches: deque[Switch] = field(default_factory=lambda: deque(maxlen=_KEPT_SWITCHES))
    sizes: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_KEPT_SWITCHES))  # (width, height)
    resized: int = 0
    first_ns: int = 0  # when the first was shown
    last_ns: int = 0  # when the last picture was, whoever showed it
    _stamps: NDArray[np.int64] = field(default_factory=lambda: np.full((KEPT_FRAMES, 11), -1, np.int64), repr=False)  # touched: it is there
    _tiers: list[str] = field(default_factory=list, repr=False)

    def add(self, item: Arrived, done: FrameDone, *, tier: str, deadline_ns: int, period_ns: int) -> None:
        """A frame was shown."""
        stamps, now_ns = done.stamps, done.stamps.written_ns
        if tier not in self._tiers:
            self._tiers.append(tier)
        self._stamps[self.shown % len(self._stamps)] = (
            item.first_ns,
            item.last_ns,
            item.ready_ns,
            stamps.packet_ns,
            stamps.decoded_ns,
            stamps.upscaled_ns,
            now_ns,
            -1 if item.sent_ns is None else item.sent_ns,
            self._tiers.index(tier),
            self.resized,
            stamps.decoded_ns if done.computed_share else -1,
        )
        if not self.shown:
            self.first_ns = now_ns
        self._gap(now_ns, period_ns)
        self.shown += 1
        self.late += now_ns - item.last_ns > deadline_ns
        self.damaged += done.decoded.damaged
        self.repeated += not done.computed_share
        self.tier_frames[tier] += 1
        if done.restart is not None:
            self.restarts[done.restart.name.lower()] += 1

    def add_unready(self, now_ns: int, *, period_ns: int) -> None:
        """The last tier showed a frame while the others were made ready."""
        self.unready += 1
        self._gap(now_ns, period_ns)

    def _gap(self, now_ns: int, period_ns: int) -> None:
        if self.shown:
            gap_ns = now_ns - self.last_ns
            self.freezes += gap_ns > FREEZE_PERIODS * period_ns
            self.longest_gap_ns = max(self.longest_gap_ns, gap_ns)
        self.last_ns = now_ns

    def resize(self, size: tuple[int, int]) -> None:
        """The picture is (width, height) from now on."""
        self.resized += 1
        self.sizes.append(size)

    def switch(self, switch: Switch) -> None:
        self.switched += 1
        self.switches.append(switch)

    @property
    def missed(self) -> int:
        """Frames that were late or left out."""
        return self.late + self.left_out

    def durations_ns(self, *, network: bool, newest: int | None = None) -> dict[str, NDArray[np.int64]]:
        """By stage, of the `newest` frames, by default of all that are kept; with `network` also what only packets tell.

        Stages without any are left out.
        """
        rows, durations = self._rows(newest), {}
        for stage, (begin, end) in _STAGES.items():
            known = rows[rows[:, begin] != -1] if network or stage not in _OF_THE_NETWORK else rows[:0]
            if len(known):
                durations[stage] = known[:, end] - known[:, begin]
        return durations

    def most_shown(self) -> tuple[str, list[Stamps]]:
        """The tier that made most of the kept pictures of the present size, and their stamps; raises ValueError where there are none."""
        rows = self._rows()
        rows = rows[(rows[:, _SIZE] == self.resized) & (rows[:, _COMPUTED] != -1)]
        if not len(rows):
            raise ValueError("no picture of the present size was computed")
        tier = int(np.bincount(rows[:, _TIER]).argmax())
        passed = rows[rows[:, _TIER] == tier][:, [_PACKET, _DECODED, _UPSCALED, _PRESENTED]]
        return self._tiers[tier], [Stamps(*row) for row in passed.tolist()]

    def _rows(self, newest: int | None = None) -> NDArray[np.int64]:
        kept = len(self._stamps)
        count = min(self.shown, kept, newest or kept)
        return self._stamps[np.arange(self.shown - count, self.shown) % kept]

    def latencies(self, *, network: bool, newest: int | None = None) -> dict[str, LatencySummary]:
        durations = self.durations_ns(network=network, newest=newest)
        return {stage: LatencySummary.of(taken.tolist()) for stage, taken in durations.items()}
