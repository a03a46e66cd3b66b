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

import client.tiers
from client.errors import InputError, ModelError
from client.frames import Frame
from client.play_source import Arrived, Idle
from client.play_tally import PlayTally
from client.player import Player
from client.sink import NullSink
from client.tiers import TieredUpscaler
from client.upscaler import OnnxUpscaler, State
from tests.moving import picture
from tests.playing import LONG_NS, Kept, Told
from tests.streaming import planes

ModelFile = Callable[..., Path]
FPS = 60


class Script:
    """A source that plays frames at once; `waits` says how many newer ones wait behind each, `ages_ns` how old each is."""

    name = "script"
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
            timed = replace(frame, pts=index, time_base=Fraction(1, FPS))
            yield Arrived(timed, now_ns, now_ns, at_ns, at_ns, at_ns, None)
        for _ in range(self._idles):
            idle()


def moving(count: int, height: int = 32, width: int = 48) -> list[Frame]:
    return [picture(t, height, width) for t in range(count)]


@pytest.fixture
def tiers(model_file: ModelFile) -> TieredUpscaler:
    """Two recurrent tiers with different pictures and one without a state."""
    files = [model_file("a.onnx", gain=0.9), model_file("b.onnx", gain=0.3), model_file("c.onnx", stateful=False)]
    made = TieredUpscaler([str(file) for file in files], display_height=None, provider="cpu", threads=1)
    made.prepare(32, 48)
    return made


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


@pytest.mark.parametrize(("before", "after"), [(0, 1), (1, 0), (0, 2), (2, 0), (2, 1)])
def test_a_switch_is_no_flash(tiers: TieredUpscaler, before: int, after: int) -> None:
    """A picture that stands still: over the switch it moves by no more than the two tiers' own pictures of it differ."""
    still = picture(3, 32, 48)
    state, pictures = tiers.initial_state(32, 48), []
    for number in range(12):
        tiers.tier = before if number < 6 else after
        shown, state = tiers.step(still, state)
        pictures.append(shown)
    own = []
    for tier in (before, after):
        alone = OnnxUpscaler(Path(tiers.names[tier]), threads=1)
        memory, seen = alone.initial_state(32, 48), []
        for _ in range(6):
            result, memory = alone.step(still, memory)
            seen.append(result)
        own.append(seen)
    assert [planes(shown) for shown in pictures] == [planes(shown) for seen in own for shown in seen]  # each from an empty memory
    step = np.abs(pictures[6].y.astype(int) - pictures[5].y).max()
    assert step <= max(np.abs(a.y.astype(int) - b.y).max() for a in own[0] for b in own[1])


def test_a_tier_that_comes_back_remembers_nothing(tiers: TieredUpscaler) -> None:
    frames, state = moving(9), tiers.initial_state(32, 48)
    for number, frame in enumerate(frames):
        tiers.tier = 1 if 3 <= number < 6 else 0
        shown, state = tiers.step(frame, state)
    alone = OnnxUpscaler(Path(tiers.names[0]), threads=1)
    memory = alone.initial_state(32, 48)
    for frame in frames[6:]:
        want, memory = alone.step(frame, memory)
    assert planes(shown) == planes(want)


def test_a_state_of_before_is_refused(tiers: TieredUpscaler) -> None:
    state = tiers.initial_state(32, 48)
    tiers.initial_state(32, 48)
    with pytest.raises(ValueError, match="begun anew"):
        tiers.step(picture(0, 32, 48), state)


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


def test_a_display_chooses_the_scale(model_file: ModelFile, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {scale: model_file(f"t_x{scale}.onnx", scale=scale) for scale in (2, 3)}
    monkeypatch.setattr("client.tiers.find_model", lambda name, scale: files[scale])
    made = TieredUpscaler(["t"], display_height=108, provider="cpu", threads=1)
    for height, scale in ((36, 3), (54, 2), (40, 3), (48, 2), (12, 3)):
        made.prepare(height, 48)
        assert made.specs[0].scale == scale


def test_tiers_that_do_not_go_together(model_file: ModelFile) -> None:
    files = [str(model_file(f"t{scale}.onnx", scale=scale)) for scale in (2, 3)]
    with pytest.raises(ModelError, match="different scales"):
        TieredUpscaler(files, display_height=None, provider="cpu", threads=1)
    with pytest.raises(ModelError, match="no model named 'nothing'"):
        TieredUpscaler(["bicubic", "nothing"], display_height=None, provider="cpu", threads=1)


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
    timed = client.tiers._timed

    def slowly(upscaler: OnnxUpscaler, height: int, width: int, computing: threading.Lock) -> tuple[State, int]:
        if upscaler.spec.state:
            assert gate.wait(60)
        return timed(upscaler, height, width, computing)

    monkeypatch.setattr("client.tiers._timed", slowly)
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


def test_what_plays_does_not_slow_down_what_is_timed(model_file: ModelFile, monkeypatch: pytest.MonkeyPatch) -> None:
    """One model computes at a time, also while a thread makes the other tiers ready."""
    at_work, most, step = 0, 0, OnnxUpscaler.step

    def counting(self: OnnxUpscaler, frame: Frame, state: State) -> tuple[Frame, State]:
        nonlocal at_work, most
        at_work += 1
        most = max(most, at_work)
        time.sleep(0.002)
        try:
            return step(self, frame, state)
        finally:
            at_work -= 1

    monkeypatch.setattr(OnnxUpscaler, "step", counting)
    names = [str(model_file(f"tier{number}.onnx", stateful=True)) for number in range(3)]
    with TieredUpscaler(names, display_height=None, provider="cpu", threads=1) as tiers:
        while not tiers.ready(32, 48):
            time.sleep(0.001)
        assert not tiers.complete
        frame, state = picture(0, 32, 48), tiers.initial_state(32, 48)
        while not tiers.complete:
            _, state = tiers.step(frame, state)
    assert most == 1


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
