"""An artifact run frame by frame: the state's rules, and sizes that do not fit."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from client.errors import InputError, ModelError
from client.frames import ColourTags, Frame
from client.upscaler import OnnxUpscaler, State
from tests.stepping import same

ModelFile = Callable[..., Path]


def noise(seed: int, height: int = 10, width: int = 14) -> Frame:
    rng = np.random.default_rng(seed)
    chroma = (-(-height // 2), -(-width // 2))
    y, u, v = (rng.integers(0, 256, shape, dtype=np.uint8) for shape in ((height, width), chroma, chroma))
    return Frame(y, u, v, seed, Fraction(1, 30))


def run(upscaler: OnnxUpscaler, frames: list[Frame], state: State | None = None) -> list[Frame]:
    state = state or upscaler.initial_state(frames[0].height, frames[0].width)
    pictures = []
    for frame in frames:
        picture, state = upscaler.step(frame, state)
        pictures.append(picture)
    return pictures


def tiny_in_numpy(frames: list[Frame], scale: int) -> list[Frame]:
    """What the tiny artifact computes, written down a second time."""
    state, pictures = np.zeros(()), []
    for frame in frames:
        height, width = frame.y.shape
        mean = frame.y.astype(np.float32).reshape(height // 2, 2, width // 2, 2).mean((1, 3))
        state = 0.5 * state + mean
        big = frame.y.repeat(scale, 0).repeat(scale, 1)
        memory = state.repeat(2 * scale, 0).repeat(2 * scale, 1)
        luma = np.clip(0.875 * big + 0.125 * memory, 0, 255).astype(np.uint8)
        pictures.append(Frame(luma, *(plane.repeat(scale, 0).repeat(scale, 1) for plane in (frame.u, frame.v))))
    return pictures


@pytest.mark.parametrize("scale", [2, 3])
def test_steps_compute_what_the_artifact_says(model_file: ModelFile, scale: int) -> None:
    frames = [noise(seed) for seed in range(5)]
    pictures = run(OnnxUpscaler(model_file(scale=scale)), frames)
    assert all(same(got, expected) for got, expected in zip(pictures, tiny_in_numpy(frames, scale), strict=True))


def test_picture_carries_what_the_frame_carried(model_file: ModelFile) -> None:
    frame = Frame(*(np.zeros(s, np.uint8) for s in ((4, 6), (2, 3), (2, 3))), 77, Fraction(1, 90000), ColourTags(2, 5, 6, 5), damaged=True)
    upscaler = OnnxUpscaler(model_file())
    picture, _ = upscaler.step(frame, upscaler.initial_state(4, 6))
    assert (picture.pts, picture.time_base, picture.colour, picture.damaged) == (77, Fraction(1, 90000), ColourTags(2, 5, 6, 5), True)


def test_the_state_matters_and_is_carried(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    first, second = run(upscaler, [noise(0), noise(0)])
    assert not np.array_equal(first.y, second.y)


def test_a_clip_gives_the_same_pictures_every_time(model_file: ModelFile) -> None:
    frames = [noise(seed) for seed in range(4)]
    upscaler = OnnxUpscaler(model_file())
    assert all(same(a, b) for a, b in zip(run(upscaler, frames), run(upscaler, frames), strict=True))


def test_a_consumed_state_is_refused(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    state = upscaler.initial_state(10, 14)
    upscaler.step(noise(0), state)
    with pytest.raises(ValueError, match="consumed"):
        upscaler.step(noise(1), state)
    with pytest.raises(ValueError, match="consumed"):
        state.copy()


def test_a_copy_goes_on_from_where_it_was_taken(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    _, state = upscaler.step(noise(0), upscaler.initial_state(10, 14))
    kept = state.copy()
    tail = [noise(seed) for seed in range(1, 4)]
    assert all(same(a, b) for a, b in zip(run(upscaler, tail, state), run(upscaler, tail, kept), strict=True))


def test_a_state_goes_on_from_what_it_gave_out(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    _, state = upscaler.step(noise(0), upscaler.initial_state(10, 14))
    tensors = [tensor.copy() for tensor in state.tensors()]
    assert [tensor.shape for tensor in tensors] == [(1, 1, 5, 7)] and np.ptp(tensors[0]) > 0
    tail = [noise(seed) for seed in range(1, 4)]
    again = upscaler.state_of(10, 14, tensors)
    expected = run(upscaler, tail, state)
    assert all(same(a, b) for a, b in zip(expected, run(upscaler, tail, again), strict=True))
    assert all(same(a, b) for a, b in zip(expected, run(upscaler, tail, upscaler.state_of(10, 14, tensors)), strict=True))
    with pytest.raises(ValueError, match="consumed"):
        state.tensors()


def test_streams_on_one_upscaler_do_not_mix(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    ours, theirs = [noise(seed) for seed in range(4)], [noise(seed) for seed in range(10, 14)]
    alone = run(upscaler, ours)
    a, b = upscaler.initial_state(10, 14), upscaler.initial_state(10, 14)
    for frame, other, expected in zip(ours, theirs, alone, strict=True):
        picture, a = upscaler.step(frame, a)
        _, b = upscaler.step(other, b)
        assert same(picture, expected)


def test_a_picture_is_valid_for_as_long_as_it_is_held(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    frames = [noise(seed) for seed in range(6)]
    pictures = run(upscaler, frames)
    assert all(same(a, b) for a, b in zip(pictures, tiny_in_numpy(frames, 2), strict=True))


def test_rows_may_lie_apart(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    frame = noise(0)
    wide = [np.pad(plane, ((0, 3), (0, 50)))[: plane.shape[0], : plane.shape[1]] for plane in (frame.y, frame.u, frame.v)]
    assert all(plane.strides[0] > plane.shape[1] for plane in wide)
    assert same(run(upscaler, [Frame(*wide)])[0], run(upscaler, [frame])[0])


@pytest.mark.parametrize(("height", "width"), [(9, 13), (9, 14), (10, 13), (2, 2), (1, 1)])
@pytest.mark.parametrize("multiple", [2, 4])
def test_a_size_that_does_not_fit_is_padded_by_its_edge_and_cropped(model_file: ModelFile, height: int, width: int, multiple: int) -> None:
    upscaler = OnnxUpscaler(model_file(metadata={"size_multiple": str(multiple)}))
    frames = [noise(seed, height, width) for seed in range(3)]
    high, wide = -height % multiple, -width % multiple
    padded = []
    for frame in frames:
        rows, columns = (height + high) // 2 - frame.u.shape[0], (width + wide) // 2 - frame.u.shape[1]
        chroma = (np.pad(plane, ((0, rows), (0, columns)), mode="edge") for plane in (frame.u, frame.v))
        padded.append(Frame(np.pad(frame.y, ((0, high), (0, wide)), mode="edge"), *chroma))
    for got, whole in zip(run(upscaler, frames), run(upscaler, padded), strict=True):
        assert (got.y.shape, got.u.shape) == ((2 * height, 2 * width), (height, width))
        assert same(got, Frame(whole.y[: 2 * height, : 2 * width], whole.u[:height, :width], whole.v[:height, :width]))


def test_an_odd_result_keeps_its_size(model_file: ModelFile) -> None:
    (picture,) = run(OnnxUpscaler(model_file(scale=3)), [noise(0, 5, 7)])
    assert (picture.y.shape, picture.u.shape, picture.v.shape) == ((15, 21), (8, 11), (8, 11))


def test_a_lost_state_starts_again_from_zeros(model_file: ModelFile) -> None:
    """With a gain of 1e30 the state overflows at every third frame; that frame must look like a first one."""
    upscaler = OnnxUpscaler(model_file(gain=1e30))
    frames = [noise(seed) for seed in range(6)]
    state, restarted = upscaler.initial_state(10, 14), []
    for index, frame in enumerate(frames):
        picture, state = upscaler.step(frame, state)
        restarted.append(state.restarted)
        if state.restarted:
            assert same(picture, run(upscaler, [frame])[0]), index
    assert restarted == [False, False, True, False, True, False]


def test_a_model_that_always_loses_its_state_is_refused(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file(gain=float("nan")))
    with pytest.raises(ModelError, match="loses its state"):
        run(upscaler, [noise(0)])


def test_a_frame_of_another_size_than_its_state_is_refused(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    with pytest.raises(ValueError, match="12x10 frame for a state of 14x10"):
        upscaler.step(noise(0, 10, 12), upscaler.initial_state(10, 14))


def test_a_result_beyond_reason_is_refused(model_file: ModelFile) -> None:
    with pytest.raises(InputError, match="megapixels"):
        OnnxUpscaler(model_file()).initial_state(8192, 4096)


def test_a_stateless_artifact_runs_the_same_way(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file(stateful=False))
    (picture,) = run(upscaler, [noise(0)])
    assert upscaler.spec.state == () and np.array_equal(picture.y, noise(0).y.repeat(2, 0).repeat(2, 1))
