"""The live loop: what is shown, what is left out, what a switch of tiers looks like, and how it ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pytest

from client.errors import InputError
from client.frames import Frame
from client.play_source import Arrived, Idle
from client.play_tally import FREEZE_PERIODS, PlayTally
from client.player import Player
from client.sink import NullSink
from client.tiers import TieredUpscaler, _Preparation
from client.upscaler import OnnxUpscaler, State
from tests.moving import picture
from tests.playing import LONG_NS, Kept, Told
from tests.streaming import planes

ModelFile = Callable[..., Path]


class Script:
    """A source that plays frames at once; `waits` says how many newer ones wait behind each, `ages_ns` how old each is."""

    name = "script"
    fps = 60
    reception = None
    decode_errors = 0

    def __init__(self, frames: list[Frame], *, waits: dict[int, int] | None = None, age_ns: int = 0, idles: int = 0) -> None:
        self.size: tuple[int, int] | None = None
        self._frames, self._waits, self._age_ns, self._idles = frames, waits or {}, age_ns, idles
        self._index = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        pass

    def waiting(self) -> int:
        return self._waits.get(self._index, 0)

    def frames(self, idle: Idle) -> Iterator[Arrived]:
        for index, frame in enumerate(self._frames):
            self._index = index
            now_ns = time.perf_counter_ns()
            at_ns = now_ns - self._age_ns
            timed = replace(frame, pts=index, time_base=Fraction(1, self.fps))
            yield Arrived(timed, now_ns, now_ns, at_ns, at_ns, at_ns, None)
        for _ in range(self._idles):
            idle()


def moving(count: int, height: int = 32, width: int = 48) -> list[Frame]:
    return [picture(t, height, width) for t in range(count)]


def player(source: Script, tiers: TieredUpscaler, sink: Kept | NullSink, **options: object) -> tuple[Player, Told]:
    told = Told()
    settings = {"tell": told, "over": lambda: None, "deadline_ns": LONG_NS} | options
    return Player(source, tiers, sink, **settings), told


def test_every_frame_is_shown_as_the_upscaler_makes_it(tiers: TieredUpscaler) -> None:
    frames, sink = moving(8), Kept()
    playing, told = player(Script(frames), tiers, sink)
    assert playing.play() == "the stream ended"
    alone = OnnxUpscaler(Path(tiers.names[tiers.tier]), threads=1)
    state = alone.initial_state(32, 48)
    for frame, shown in zip(frames, sink.pictures, strict=True):
        want, state = alone.step(frame, state)
        assert planes(shown) == planes(want)
    assert playing.tally.shown == 8 and playing.tally.missed == 0 and told.kinds() == ["begin"]


def test_pictures_shown_again_are_counted_and_say_nothing_of_the_model(model_file: ModelFile) -> None:
    """Each frame is shown at its time; upscaling was done, and is timed, once for each that is new."""
    tiers = TieredUpscaler([str(model_file(stateful=False))], display_height=None, provider="cpu", threads=1)
    tiers.prepare(32, 48)
    sink = Kept()
    playing, _ = player(Script([frame for frame in moving(5) for _ in range(4)]), tiers, sink)
    playing.play()
    tally = playing.tally
    assert (tally.shown, len(sink.pictures), tally.repeated) == (20, 20, 15)
    durations = tally.durations_ns(network=False)
    assert len(durations["total"]) == 20 and len(durations["upscale"]) == 5
    assert len(tally.most_shown()[1]) == 5


def test_who_waits_is_left_out_and_all_are_counted(tiers: TieredUpscaler) -> None:
    """Only what cannot be in time, and only where newer ones wait."""
    late = Script(moving(20), waits={3: 1, 4: 2, 5: 1, 9: 1}, age_ns=50_000_000)
    sink = Kept()
    playing, _ = player(late, tiers, sink, deadline_ns=10_000_000)
    playing.play()
    assert [frame.pts for frame in sink.pictures] == [n for n in range(20) if n not in (3, 4, 5, 9)]
    assert (playing.tally.shown, playing.tally.late, playing.tally.left_out) == (16, 16, 4)
    playing, _ = player(Script(moving(20), waits=dict.fromkeys(range(20), 1)), tiers, Kept())
    playing.play()
    assert playing.tally.left_out == 0 and playing.tally.shown == 20  # a late deadline: all can be in time


def test_even_then_the_picture_moves(tiers: TieredUpscaler) -> None:
    sink = Kept()
    playing, _ = player(Script(moving(40), waits=dict.fromkeys(range(40), 5), age_ns=50_000_000), tiers, sink, deadline_ns=1_000_000)
    playing.play()
    assert [frame.pts for frame in sink.pictures] == [10, 31]  # after twice the five, and twice that again


def test_another_size_in_mid_stream(tiers: TieredUpscaler) -> None:
    """Frames that come while the tiers are made ready for it are decoded, and shown by the last tier if any; then it goes on by itself."""
    sink = Kept()

    class Changing(Script):
        def frames(self, idle: Idle) -> Iterator[Arrived]:
            for item in super().frames(idle):
                yield item
                if item.frame.height == 64:
                    tiers.prepare(64, 96)

    playing, told = player(Changing(moving(5) + moving(6, 64, 96)), tiers, sink)
    playing.play()
    tally = playing.tally
    assert tally.shown + tally.unready == 11 and tally.unready <= 2
    assert {frame.height for frame in sink.pictures} == {64, 128} and list(tally.sizes) == [(48, 32), (96, 64)]
    assert tally.restarts == {"size": 1} and [kind for kind in told.kinds() if kind != "unready"] == ["begin", "size", "begin"]


def test_it_ends_when_it_is_told_to(tiers: TieredUpscaler) -> None:
    playing, _ = player(Script(moving(8)), tiers, NullSink(), frames=5)
    assert playing.play() == "5 frames were shown" and playing.tally.shown == 5
    playing, _ = player(Script(moving(3), idles=10**9), tiers, NullSink(), seconds=0.2)
    assert playing.play() == "the time was over" and playing.tally.shown <= 3
    answers = iter([None, None, "enough"])
    playing, _ = player(Script(moving(3), idles=10**9), tiers, NullSink(), over=lambda: next(answers))
    assert playing.play() == "enough" and playing.tally.shown == 3


def test_the_last_tier_shows_it_until_all_are_ready(model_file: ModelFile, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those frames are in no latency; what the governor begins with comes after them."""
    gate = threading.Event()
    timed = _Preparation._timed

    def slowly(self: _Preparation, upscaler: OnnxUpscaler) -> tuple[State, int]:
        if upscaler.spec.state:
            assert gate.wait(60)
        return timed(self, upscaler)

    monkeypatch.setattr(_Preparation, "_timed", slowly)
    files = [str(model_file("a.onnx")), str(model_file("c.onnx", stateful=False))]
    sink = Kept()
    with TieredUpscaler(files, display_height=None, provider="cpu", threads=1) as tiers:
        while not tiers.ready(32, 48):
            time.sleep(0.01)

        class Opening(Script):
            def frames(self, idle: Idle) -> Iterator[Arrived]:
                for item in super().frames(idle):
                    if item.frame.pts == 4:
                        gate.set()
                        tiers.prepare(32, 48)
                    yield item

        playing, told = player(Opening(moving(9)), tiers, sink)
        playing.play()
    assert (playing.tally.unready, playing.tally.shown, len(sink.pictures)) == (4, 5, 9)
    assert told.kinds() == ["unready", "begin"]
    assert [(s.before, s.after, s.reason) for s in playing.tally.switches] == [(1, 0, "all tiers are ready")]
    plain = OnnxUpscaler(Path(files[1]), threads=1)
    for frame, shown in zip(moving(4), sink.pictures, strict=False):
        assert planes(plain.step(frame, plain.initial_state(32, 48))[0]) == planes(shown)


@pytest.mark.parametrize("complete", [False, True])
def test_a_size_that_goes_and_comes_back_in_warm_up(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch, complete: bool) -> None:
    """Another size for three pictures. If all tiers were ready for the first it goes on as if nothing had been; else they are made anew."""
    timed = _Preparation._timed

    def slowly(self: _Preparation, upscaler: OnnxUpscaler) -> tuple[State, int]:
        if self.size != (48, 64) or upscaler.spec.state:
            self.stop.wait(0.2)  # too slow for what comes here
        return timed(self, upscaler)

    class Returning(Script):
        def frames(self, idle: Idle) -> Iterator[Arrived]:
            for item in super().frames(idle):
                if item.frame.pts == 10:
                    tiers.prepare(48, 64)
                yield item

    monkeypatch.setattr(_Preparation, "_timed", slowly)
    if complete:
        tiers.prepare(48, 64)
    while not tiers.ready(48, 64):
        time.sleep(0.001)
    playing, told = player(Returning(moving(4, 48, 64) + moving(3) + moving(9, 48, 64)), tiers, NullSink())
    playing.play()
    assert (playing.tally.unready, playing.tally.shown) == ((3, 13) if complete else (10, 6))
    assert told.kinds() == (["begin"] if complete else ["unready", "begin"])
    assert playing.governor is not None and playing.governor.tier == tiers.tier and all(tiers.costs_ns)


def test_what_is_too_large_is_not_shown_and_ends_nothing(tiers: TieredUpscaler) -> None:
    huge = Frame(np.broadcast_to(np.uint8(9), (8192, 8192)), *[np.broadcast_to(np.uint8(9), (4096, 4096))] * 2)
    sink = Kept()

    class Slowly(Script):
        def frames(self, idle: Idle) -> Iterator[Arrived]:
            for item in super().frames(idle):
                yield item
                while tiers._preparation is not None and tiers._preparation.is_alive():
                    time.sleep(0.001)

    playing, told = player(Slowly(moving(3) + [huge] * 3 + moving(3)), tiers, sink)
    assert playing.play() == "the stream ended"
    assert len(sink.pictures) == 6 and playing.tally.shown == 6 and playing.tally.unready <= 1
    assert told.kinds().count("refused") >= 2 and "8192x8192" in dict(told.said)["refused"]


def test_what_the_last_tier_shows_is_no_freeze(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a change of size only the last tier is ready for longer than a freeze takes, and the picture moves all the time."""
    gate, timed = threading.Event(), _Preparation._timed

    def slowly(self: _Preparation, upscaler: OnnxUpscaler) -> tuple[State, int]:
        assert not upscaler.spec.state or gate.wait(60)
        return timed(self, upscaler)

    class Paced(Script):
        fps = 5

        def frames(self, idle: Idle) -> Iterator[Arrived]:
            for item in super().frames(idle):
                if item.frame.pts == 3:
                    while not tiers.ready(64, 96):
                        time.sleep(0.001)
                if item.frame.pts == 19:
                    gate.set()
                    tiers.prepare(64, 96)
                time.sleep(0.05)
                yield item

    monkeypatch.setattr(_Preparation, "_timed", slowly)
    playing, _ = player(Paced(moving(3) + moving(18, 64, 96)), tiers, NullSink())
    playing.play()
    tally = playing.tally
    assert (tally.unready, tally.shown, tally.freezes) == (16, 5, 0)
    assert tally.last_ns - tally.first_ns > FREEZE_PERIODS * playing.period.ns > tally.longest_gap_ns
    tally.add_unready(tally.last_ns + 2 * FREEZE_PERIODS * playing.period.ns, period_ns=playing.period.ns)
    assert tally.freezes == 1  # whoever shows it


def test_nothing_shown_is_said(tiers: TieredUpscaler) -> None:
    playing, _ = player(Script([]), tiers, NullSink())
    with pytest.raises(InputError, match="no picture of script could be shown"):
        playing.summary(playing.play(), {})


def test_the_end_of_damage_begins_the_memory_anew_without_new_buffers(tiers: TieredUpscaler) -> None:
    frames = [replace(frame, damaged=3 <= t < 5) for t, frame in enumerate(moving(8))]
    playing, _ = player(Script(frames), tiers, NullSink())
    before = {id(state._buffers) for state in tiers._states.values()}
    playing.play()
    assert playing.tally.restarts == {"damage": 1} and playing.tally.damaged == 2
    assert {id(state._buffers) for state in tiers._states.values()} == before


def test_the_tally_does_not_grow(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch) -> None:
    """The newest frames are what percentiles are of, in the order in which they came."""
    monkeypatch.setattr("client.play_tally.KEPT_FRAMES", 4)
    playing, _ = player(Script(moving(10)), tiers, NullSink())
    playing.play()
    tally = playing.tally
    assert tally.latencies(network=False)["total"].count == 4 and len(tally.durations_ns(network=False, newest=2)["total"]) == 2
    written = tally._stamps[[(6 + n) % 4 for n in range(4)], 6]
    assert (np.diff(written) > 0).all() and written[-1] == tally.last_ns
    assert PlayTally().latencies(network=True) == {}
