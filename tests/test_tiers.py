"""Several models as one upscaler: what a switch looks like, how they are made ready, and what becomes of that when it is disturbed."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import client.tiers
from client.errors import ModelError
from client.frames import Frame
from client.tiers import TieredUpscaler
from client.upscaler import OnnxUpscaler, State
from tests.moving import picture
from tests.streaming import planes

ModelFile = Callable[..., Path]
LONG_S = 60.0


@pytest.mark.parametrize(("before", "after"), [(0, 1), (1, 0), (0, 2), (2, 0), (2, 1)])
def test_a_switch_begins_with_an_empty_memory(tiers: TieredUpscaler, before: int, after: int) -> None:
    still = picture(3, 32, 48)
    state, pictures = tiers.initial_state(32, 48), []
    for number in range(12):
        tiers.tier = before if number < 6 else after
        shown, state = tiers.step(still, state)
        pictures.append(shown)
    own = []
    for tier in (before, after):
        alone = OnnxUpscaler(Path(tiers.names[tier]), threads=1)
        memory = alone.initial_state(32, 48)
        for _ in range(6):
            result, memory = alone.step(still, memory)
            own.append(result)
    assert [planes(shown) for shown in pictures] == [planes(alone) for alone in own]


@pytest.mark.parametrize(("before", "after"), [(0, 1), (1, 0), (2, 0), (2, 1)])
def test_a_switch_is_no_flash(before: int, after: int) -> None:
    """Over a switch a picture that stands still moves by what the two models' settled pictures of it differ.

    The second one remembered noise when it was left: shown with that it would move by up to half as much again.
    """
    still = picture(3, 48, 64)
    other = replace(still, y=np.random.default_rng(1).integers(0, 256, (48, 64), np.uint8))
    with TieredUpscaler(["gamesr", "gamesr-paper", "bicubic"], display_height=None, provider="cpu", threads=1) as tiers:
        tiers.prepare(48, 64)
        state, pictures = tiers.initial_state(48, 64), []
        for tier, frame, count in ((after, other, 4), (before, still, 10), (after, still, 10)):
            tiers.tier = tier
            for _ in range(count):
                shown, state = tiers.step(frame, state)
                pictures.append(shown.y.astype(float))
    settled, first, settles = pictures[13], pictures[14], pictures[23]
    assert np.linalg.norm(first - settled) <= 1.05 * np.linalg.norm(settles - settled)


def test_a_tier_that_comes_back_remembers_nothing(tiers: TieredUpscaler) -> None:
    frames, state = [picture(t, 32, 48) for t in range(9)], tiers.initial_state(32, 48)
    for number, frame in enumerate(frames):
        tiers.tier = 1 if 3 <= number < 6 else 0
        shown, state = tiers.step(frame, state)
    alone = OnnxUpscaler(Path(tiers.names[0]), threads=1)
    memory = alone.initial_state(32, 48)
    for frame in frames[6:]:
        want, memory = alone.step(frame, memory)
    assert planes(shown) == planes(want)


def test_a_picture_that_comes_again_is_not_computed_without_a_memory(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one it is, and so it is with another tier, and for a stream that begins anew."""
    step, ran = OnnxUpscaler.step, []

    def watched(self: OnnxUpscaler, frame: Frame, state: State) -> tuple[Frame, State]:
        ran.append(self.spec.sha256)
        return step(self, frame, state)

    monkeypatch.setattr(OnnxUpscaler, "step", watched)
    still, pictures, shares = picture(3, 32, 48), [], []
    state = tiers.initial_state(32, 48)
    for tier in (2, 2, 2, 0, 0, 2, 2):
        tiers.tier = tier
        shown, state = tiers.step(still, state)
        pictures.append(planes(shown))
        shares.append(state.computed_share)
    assert shares == [1, 0, 0, 1, 1, 1, 0] and len(set(pictures[:3] + pictures[5:])) == 1
    assert ran == [tiers.specs[tier].sha256 for tier in (2, 0, 0, 2)]
    _, state = tiers.step(still, tiers.initial_state(32, 48))
    assert state.computed_share == 1


def test_a_pause_is_looked_into_now_and_then_below_the_best_tier(model_file: ModelFile) -> None:
    still, files = picture(3, 32, 48), [str(model_file(f"{name}.onnx", stateful=False)) for name in "ab"]
    with TieredUpscaler(files, display_height=None, provider="cpu", threads=1) as tiers:
        tiers.prepare(32, 48)
        for tier, computed in ((0, 1), (1, 4)):
            state, shares, tiers.tier = tiers.initial_state(32, 48), [], tier
            for _ in range(3 * (client.tiers.MOST_REPEATS + 1) + 1):
                _, state = tiers.step(still, state)
                shares.append(state.computed_share)
            assert sum(shares) == computed


def test_a_state_of_before_is_refused(tiers: TieredUpscaler) -> None:
    state = tiers.initial_state(32, 48)
    tiers.initial_state(32, 48)
    with pytest.raises(ValueError, match="begun anew"):
        tiers.step(picture(0, 32, 48), state)


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


@pytest.mark.parametrize("tier", [0, 2])
def test_a_thread_that_dies_is_heard_of(tiers: TieredUpscaler, monkeypatch: pytest.MonkeyPatch, tier: int) -> None:
    """Whatever it dies of: before the last tier is there, nobody waits for ever; after it, no tier is chosen that is not ready."""
    step, dead = OnnxUpscaler.step, tiers._upscalers[tier]

    def dying(self: OnnxUpscaler, frame: Frame, state: State) -> tuple[Frame, State]:
        if self is dead:
            raise MemoryError("no memory is left")
        return step(self, frame, state)

    monkeypatch.setattr(OnnxUpscaler, "step", dying)
    end = time.monotonic() + LONG_S
    with pytest.raises(ModelError, match="64x64: no memory is left"):
        while not (tiers.ready(64, 64) and tiers.complete) and time.monotonic() < end:
            time.sleep(0.001)


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The threads of which each step was, in order; each step takes 20 ms."""
    step, threads = OnnxUpscaler.step, []

    def slow(self: OnnxUpscaler, frame: Frame, state: State) -> tuple[Frame, State]:
        threads.append(threading.current_thread().name)
        time.sleep(0.02)
        return step(self, frame, state)

    monkeypatch.setattr(OnnxUpscaler, "step", slow)
    return threads


def test_what_plays_goes_on_while_others_are_timed(tiers: TieredUpscaler, steps: list[str]) -> None:
    """Nearly every frame that is timed is followed by one that is shown."""
    while not tiers.ready(64, 96):
        time.sleep(0.001)
    frames, state = itertools.cycle(picture(t, 64, 96) for t in range(2)), tiers.initial_state(64, 96)
    steps.clear()
    while not tiers.complete:
        _, state = tiers.step(next(frames), state)
        time.sleep(0.005)  # until the next one comes
    timed = steps.count("tiers")
    assert len(steps) - timed >= timed // 2 >= client.tiers.TIMED_FRAMES - 2


def test_a_size_that_goes_is_dropped_at_once(tiers: TieredUpscaler, steps: list[str]) -> None:
    assert not tiers.ready(64, 96)
    while not steps:
        time.sleep(0.001)
    before = len(steps)
    tiers.close()
    assert len(steps) <= before + 1


@pytest.mark.parametrize("begun", ["half", "wholly"])
def test_a_size_that_comes_back(tiers: TieredUpscaler, steps: list[str], begun: str) -> None:
    """While another one was made ready: what was half ready is made anew, and what was wholly ready still is."""
    tiers.prepare(64, 96)
    if begun == "half":
        while not tiers.ready(32, 48):
            time.sleep(0.001)
        size = (32, 48)
        assert not tiers.complete
    else:
        size = (64, 96)
        tiers.tier = 0
    assert not tiers.ready(16, 16)
    assert tiers.ready(*size) == (begun == "wholly")
    if begun == "wholly":
        assert tiers.complete and tiers.tier == 0
    tiers.prepare(*size)
    assert all(tiers.costs_ns)
    state = tiers.initial_state(*size)
    for tier in range(len(tiers.names)):
        tiers.tier = tier
        _, state = tiers.step(picture(0, *size), state)
