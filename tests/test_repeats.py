"""A frame that comes again is not computed again, and no other frame is taken for one that does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from client.models import find_model
from client.repeats import RepeatState, RepeatUpscaler, Shown
from client.skipping import SkippingUpscaler, skipping_upscaler
from client.upscaler import OnnxUpscaler
from tests.moving import picture
from tests.stepping import Spy, same

ModelFile = Callable[..., Path]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    height=st.integers(1, 25).map(lambda n: 2 * n),
    width=st.integers(1, 25).map(lambda n: 2 * n),
    plane=st.sampled_from("yuv"),
    data=st.data(),
)
def test_one_sample_anywhere_is_another_frame(height: int, width: int, plane: str, data: st.DataObject) -> None:
    frame = picture(0, height, width)
    planes = getattr(frame, plane).copy()
    row, column = data.draw(st.integers(0, planes.shape[0] - 1)), data.draw(st.integers(0, planes.shape[1] - 1))
    planes[row, column] ^= 1 << data.draw(st.integers(0, 7))
    shown = Shown(frame, picture(1, 2 * height, 2 * width))
    assert shown.again(replace(frame, **{plane: planes})) is None
    again = shown.again(replace(frame, y=frame.y.copy(), pts=7))
    assert again is not None and again.pts == 7 and same(again, shown.picture)


def test_repeats_cost_no_run_and_leave_the_memory_as_it_was(model_file: ModelFile) -> None:
    """Each frame three times gives, three times each, what the frames alone give."""
    spy, frames = Spy(model_file()), [picture(t, 32, 48) for t in range(4)]
    alone, state = [], spy.initial_state(32, 48)
    for frame in frames:
        shown, state = spy.step(frame, state)
        alone.append(shown)
    spy.taken()
    upscaler, pictures, shares = RepeatUpscaler(spy), [], []
    memory = upscaler.initial_state(32, 48)
    for frame in frames:
        for _ in range(3):
            shown, memory = upscaler.step(replace(frame, y=frame.y.copy()), memory)
            pictures.append(shown)
            shares.append(memory.computed_share)
    assert spy.taken() == [(32, 48)] * 4 and shares == [1, 0, 0] * 4
    assert all(same(shown, alone[index // 3]) for index, shown in enumerate(pictures))


def test_a_state_is_consumed_and_pictures_are_not_written_to(model_file: ModelFile) -> None:
    upscaler, frame = RepeatUpscaler(OnnxUpscaler(model_file(), threads=1)), picture(0, 32, 48)
    before: RepeatState = upscaler.initial_state(32, 48)
    shown, state = upscaler.step(frame, before)
    upscaler.step(frame, state)
    for consumed in (before, state):
        with pytest.raises(ValueError, match="consumed"):
            upscaler.step(frame, consumed)
    with pytest.raises(ValueError, match="read-only"):
        shown.y[0, 0] = 1
    with pytest.raises(ValueError, match="48x32"):
        upscaler.step(frame, upscaler.initial_state(64, 64))


def test_where_windows_cannot_be_run_repeats_are_what_is_skipped() -> None:
    frame = picture(0, 64, 96)
    moved = replace(frame, y=np.where(np.arange(64)[:, None] < 8, 255 - frame.y, frame.y))
    shares: dict[type, list[float]] = {}
    for provider in ("cpu", "openvino"):
        upscaler = skipping_upscaler(OnnxUpscaler(find_model("bicubic", 2), provider=provider, threads=1))
        state, found = upscaler.initial_state(64, 96), shares.setdefault(type(upscaler), [])
        for given_frame in (frame, frame, moved, moved):
            _, state = upscaler.step(given_frame, state)
            found.append(state.computed_share)
    assert shares == {SkippingUpscaler: [1, 0, 0.5, 0], RepeatUpscaler: [1, 0, 1, 0]}
