"""The live loop: decode, upscale, present, against a deadline; one frame at a time, the newest first."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from client.deadline import DeadlineRule, FramePeriod
from client.errors import InputError
from client.frames import Frame
from client.governor import Governor, Switch
from client.pipeline import FrameDone, Sink, upscale_stream
from client.play_source import Arrived, PlaySource, Tell
from client.play_summary import PlaySummary
from client.play_tally import PlayTally
from client.tiers import TieredUpscaler

_READY = "all tiers are ready"


class _Over(Exception):
    """The player was told to end while nothing came."""


class Player:
    """Plays a source through the tiers into a sink until it ends, the limits are reached, or `over` gives a reason to end.

    `over` is asked after every frame, and at least every 10 ms while none comes. `deadline_ns` is from the arrival of a frame's last packet
    to the return of the sink's `write`, by default one frame's period. `decoded` is given each frame before it is upscaled.
    """

    def __init__(
        self,
        source: PlaySource,
        tiers: TieredUpscaler,
        sink: Sink,
        *,
        tell: Tell,
        over: Callable[[], str | None],
        deadline_ns: int | None = None,
        frames: int | None = None,
        seconds: float | None = None,
        decoded: Callable[[Frame], None] = lambda frame: None,
    ) -> None:
        self.tally = PlayTally()
        self.period = FramePeriod()
        self.governor: Governor | None = None
        self._source, self._tiers, self._sink = source, tiers, sink
        self._tell, self._asked_over, self._decoded = tell, over, decoded
        self._deadline_ns, self._frames = deadline_ns, frames
        self._end_ns = None if seconds is None else time.perf_counter_ns() + int(seconds * 1e9)
        self._rule = DeadlineRule()
        self._size: tuple[int, int] | None = None
        self._item: Arrived | None = None
        self._shown_tier: int | None = None
        self._why = _READY  # another tier than before shows the next frame, where that is not the governor's doing

    @property
    def deadline_ns(self) -> int:
        return self._deadline_ns or self.period.ns

    def play(self) -> str:
        """Play; returns why it ended. Raises what source, tiers and sink raise."""
        try:
            if self._source.size is not None:
                width, height = self._source.size
                while not self._tiers.ready(height, width) or not self._tiers.complete:
                    self._idle()
                    time.sleep(0.01)
            for done in upscale_stream(self._in_time(), self._tiers, self._sink):
                self._account(done)
                if (reason := self._over()) is not None:
                    return reason
        except _Over as over:
            return str(over)
        return "the stream ended"

    def summary(self, ended: str, events: dict[str, int]) -> PlaySummary:
        """Raises InputError where no frame was shown."""
        source = self._source
        if not self.tally.shown:
            unready = f": {self.tally.unready} came, none of them after the models were ready" if self.tally.unready else ""
            errors = f", {source.decode_errors} could not be decoded" if source.decode_errors else ""
            raise InputError(f"no picture of {source.name} could be shown ({ended}{unready}{errors})")
        tiers = self._tiers
        return PlaySummary(
            source=source.name,
            ended=ended,
            tally=self.tally,
            specs=dict(zip(tiers.names, tiers.specs, strict=True)),
            costs_ns=tiers.costs_ns,
            provider=tiers.provider,
            threads=tiers.threads,
            deadline_ns=self.deadline_ns,
            period_ns=self.period.ns,
            reception=source.reception,
            decode_errors=source.decode_errors,
            events=events,
        )

    def _in_time(self) -> Iterator[Arrived]:
        """The source's frames without those that the deadline rule leaves out."""
        for item in self._source.frames(self._idle):
            frame, tally = item.frame, self.tally
            self.period.add(frame)
            if not self._ready(frame):
                self._idle()
                continue
            now_ns, waiting = time.perf_counter_ns(), self._source.waiting()
            if self._size != (frame.width, frame.height):
                self._resize(frame)
            if self.governor is None and self._tiers.complete:
                self._begin(now_ns)
            if self._leaves_out(now_ns - item.last_ns, waiting):
                if self.governor is None:
                    tally.unready += 1
                else:
                    tally.left_out += 1
                    self._follow(self.governor.left_out(now_ns, waiting=waiting))
                continue
            self._item = item
            self._decoded(frame)
            yield item

    def _ready(self, frame: Frame) -> bool:
        """Whether it can be upscaled: not while the tiers are made ready for its size, and never where that would be too large."""
        try:
            if self._tiers.ready(frame.height, frame.width):
                return True
        except InputError as error:
            self._tell("refused", f"not shown: {error}")
            return False
        self.tally.unready += 1
        return False

    def _leaves_out(self, age_ns: int, waiting: int) -> bool:
        governor = self.governor
        frame_ns = self._tiers.costs_ns[-1] if governor is None else governor.frame_ns
        if governor is not None:
            governor.deadline_ns, governor.period_ns = self.deadline_ns, self.period.ns
        return self._rule.leaves_out(age_ns=age_ns, waiting=waiting, frame_ns=frame_ns, deadline_ns=self.deadline_ns)

    def _resize(self, frame: Frame) -> None:
        """A picture of another size, or the first: the last tier shows it until all are ready."""
        tiers, before = self._tiers, self._size
        self._size, self.governor = (frame.width, frame.height), None
        self.tally.resize(self._size)
        if before is not None:
            self._why = "the picture changed size"
            self._tell("size", f"the picture is now {frame.width}x{frame.height}, it was {before[0]}x{before[1]}")
        if not tiers.complete:
            self._tell("unready", f"{tiers.names[-1]} shows it until all tiers are ready")

    def _begin(self, now_ns: int) -> None:
        """All tiers are ready: the best that fits is begun with."""
        tiers = self._tiers
        self.governor = Governor(tiers.costs_ns, deadline_ns=self.deadline_ns, period_ns=self.period.ns, now_ns=now_ns)
        tiers.tier = self.governor.tier
        costs = ", ".join(f"{name} {cost_ns / 1e6:.1f} ms" for name, cost_ns in zip(tiers.names, tiers.costs_ns, strict=True))
        self._tell("begin", f"{tiers.names[tiers.tier]} x{tiers.specs[0].scale} is begun with ({costs})")

    def _account(self, done: FrameDone) -> None:
        item, governor, stamps = self._item, self.governor, done.stamps
        assert item is not None
        if self._shown_tier not in (None, self._tiers.tier):
            self.tally.switch(Switch(stamps.written_ns, self._shown_tier or 0, self._tiers.tier, self._why))
            self._why = _READY
        self._shown_tier = self._tiers.tier
        if governor is None:
            self.tally.add_unready(stamps.written_ns, period_ns=self.period.ns)
            return
        self.tally.add(item, done, tier=self._tiers.names[self._tiers.tier], deadline_ns=governor.deadline_ns, period_ns=self.period.ns)
        self._follow(
            governor.shown(
                stamps.written_ns,
                latency_ns=stamps.written_ns - item.last_ns,
                busy_ns=stamps.written_ns - stamps.packet_ns,
                upscale_ns=stamps.upscaled_ns - stamps.decoded_ns,
                computed=done.computed_share > 0,
            )
        )

    def _follow(self, switch: Switch | None) -> None:
        if switch is not None:
            self._tiers.tier = self._shown_tier = switch.after
            self.tally.switch(switch)
            names = self._tiers.names
            self._tell("switch", f"{names[switch.before]} -> {names[switch.after]}: {switch.reason}")

    def _idle(self) -> None:
        if (reason := self._over()) is not None:
            raise _Over(reason)

    def _over(self) -> str | None:
        if self._frames is not None and self.tally.shown >= self._frames:
            return f"{self._frames} frames were shown"
        if self._end_ns is not None and time.perf_counter_ns() >= self._end_ns:
            return "the time was over"
        return self._asked_over()
