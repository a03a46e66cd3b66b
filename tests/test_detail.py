"""The network where the detail is: there to the bit what a whole frame gives, elsewhere the interpolation, its state left as it was."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from client.detail import SQUARE, DetailState, DetailUpscaler, gradient_energy, most_detailed
from client.errors import ModelError, ProviderError
from client.frames import Frame
from client.models import find_model
from client.upscaler import OnnxUpscaler
from model.export import export_network
from tests.networks import random_network
from tests.stepping import Spy, whole

ModelFile = Callable[..., Path]
HEIGHT, WIDTH = 200, 330  # 4 x 6 squares, the last ones cut off


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Spy:
    path = tmp_path_factory.mktemp("artifacts") / "live_x2.onnx"
    export_network(random_network("live", 2), path, name="live", card={})
    return Spy(path)


@pytest.fixture(scope="module")
def bicubic() -> Spy:
    return Spy(find_model("bicubic", 2))


@pytest.fixture
def tiny(model_file: ModelFile) -> Spy:
    """The tiny recurrent model: h = gain * h + mean of 2x2, which looks at nothing around it."""
    return Spy(model_file(metadata={"reach": "0"}))


def texture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Frame:
    """Noise whose amplitude differs from place to place, over grey."""
    rng = np.random.default_rng(seed)
    amplitude = rng.integers(0, 60, (-(-height // 32), -(-width // 32))).repeat(32, 0).repeat(32, 1)[:height, :width]
    y = 128 + amplitude * rng.uniform(-1, 1, (height, width))
    u, v = (rng.integers(0, 256, (-(-height // 2), -(-width // 2)), dtype=np.uint8) for _ in range(2))
    return Frame(y.astype(np.uint8), u, v, pts=seed)


def patch(*places: tuple[int, int]) -> Frame:
    """Grey, with a checkerboard in the squares at these rows and columns of squares."""
    y = np.full((HEIGHT, WIDTH), 100, np.uint8)
    for row, column in places:
        square = y[row * SQUARE : (row + 1) * SQUARE, column * SQUARE : (column + 1) * SQUARE]
        square += (np.indices(square.shape).sum(0) % 2 * 50).astype(np.uint8)
    chroma = np.full((HEIGHT // 2, WIDTH // 2), 128, np.uint8)
    return Frame(y, chroma, chroma)


def one(upscaler: DetailUpscaler, frame: Frame) -> tuple[Frame, DetailState]:
    return upscaler.step(frame, upscaler.initial_state(frame.height, frame.width))


def squares(picture: Frame, rows: int, columns: int) -> Iterator[tuple[tuple[int, int], tuple[np.ndarray, ...]]]:
    side = 2 * SQUARE
    for row in range(rows):
        for column in range(columns):
            luma = slice(row * side, (row + 1) * side), slice(column * side, (column + 1) * side)
            chroma = slice(row * SQUARE, (row + 1) * SQUARE), slice(column * SQUARE, (column + 1) * SQUARE)
            yield (row, column), (picture.y[luma], picture.u[chroma], picture.v[chroma])


def equal(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> bool:
    return all(np.array_equal(p, q) for p, q in zip(a, b, strict=True))


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(seed=st.integers(0, 99), height=st.integers(1, 220), width=st.integers(1, 220), share=st.floats(0.01, 0.99))
def test_every_square_is_one_or_the_other_to_the_bit(live: Spy, bicubic: Spy, seed: int, height: int, width: int, share: float) -> None:
    """The network's where the detail is, and in no more squares than the state says; the other's everywhere else."""
    frame = texture(seed, height, width)
    picture, state = one(DetailUpscaler(live, bicubic, share), frame)
    chosen = most_detailed(frame.y, SQUARE, share)
    network, base = (squares(whole(upscaler, frame), *chosen.shape) for upscaler in (live, bicubic))
    computed = 0
    for (place, ours), (_, theirs), (_, plain) in zip(squares(picture, *chosen.shape), network, base, strict=True):
        assert equal(ours, theirs) if chosen[place] else equal(ours, theirs) or equal(ours, plain)
        computed += not equal(ours, plain)
    assert computed <= round(state.computed_share * chosen.size) and chosen.mean() <= state.computed_share <= 1
    assert picture.pts == seed and not state.restarted


def test_a_square_of_detail_costs_one_window_and_its_halo(live: Spy, bicubic: Spy) -> None:
    upscaler = DetailUpscaler(live, bicubic, 1 / 24)
    reach = live.spec.reach or 0
    corner, inside = SQUARE + reach, SQUARE + 2 * reach
    rest = HEIGHT - 3 * SQUARE + reach, WIDTH - 5 * SQUARE + reach
    for place, window in (((0, 0), (corner, corner)), ((1, 2), (inside, inside)), ((3, 5), rest)):
        live.taken(), bicubic.taken()
        _, state = one(upscaler, patch(place))
        assert live.taken() == [window] and bicubic.taken() == [(HEIGHT, WIDTH)]
        assert state.computed_share == pytest.approx(1 / 24)


def test_detail_everywhere_is_one_whole_run_and_nothing_else(live: Spy, bicubic: Spy) -> None:
    live.taken(), bicubic.taken()
    frame = texture(0)
    picture, state = one(DetailUpscaler(live, bicubic, 0.95), frame)
    assert live.taken() == [(HEIGHT, WIDTH)] and bicubic.taken() == [] and state.computed_share == 1
    assert np.array_equal(picture.y, whole(live, frame).y)


def test_gradient_energy_is_the_mean_of_each_square() -> None:
    y = np.random.default_rng(0).integers(0, 256, (70, 45), dtype=np.uint8)
    luma = np.pad(y.astype(np.int64), ((0, 1), (0, 1)), mode="edge")
    squares = (luma[1:, :-1] - luma[:-1, :-1]) ** 2 + (luma[:-1, 1:] - luma[:-1, :-1]) ** 2
    expected = [[squares[r : r + 32, c : c + 32].mean() for c in (0, 32)] for r in (0, 32, 64)]
    np.testing.assert_allclose(gradient_energy(y, 32), expected)


def test_the_state_of_a_square_that_is_left_out_stays_as_it_was(tiny: Spy, bicubic: Spy) -> None:
    """h = h / 2 + mean, and an eighth of h is in the picture: what it holds can be told from what is seen."""
    upscaler = DetailUpscaler(tiny, bicubic, 1 / 24)
    state = upscaler.initial_state(HEIGHT, WIDTH)
    seen = []
    for place in ((0, 0), (0, 0), (2, 2), (2, 2), (0, 0)):
        picture, state = upscaler.step(patch(place), state)
        seen.append(int(picture.y[0, 0]))  # a checkerboard's first sample is 100; its mean 125
    held = 0.5 * (0.5 * 125 + 125) + 125  # the third time that it was computed
    assert seen == [int(0.875 * 100 + 0.125 * h) for h in (125, 187.5)] + [100, 100] + [int(0.875 * 100 + 0.125 * held)]


def test_a_state_lost_in_a_window_begins_again_everywhere(model_file: ModelFile, bicubic: Spy) -> None:
    """With this gain the state overflows in the third frame that is computed."""
    spy = Spy(model_file(gain=1e30, metadata={"reach": "0"}))
    upscaler = DetailUpscaler(spy, bicubic, 1 / 24)
    state, steps = upscaler.initial_state(HEIGHT, WIDTH), []
    for _ in range(3):
        picture, state = upscaler.step(patch((1, 1)), state)
        steps.append((state.restarted, state.computed_share == 1))
    assert steps == [(False, False), (False, False), (True, True)]
    assert np.array_equal(picture.y, whole(spy, patch((1, 1))).y)


def test_a_state_is_consumed_and_belongs_to_a_size(tiny: Spy, bicubic: Spy) -> None:
    upscaler = DetailUpscaler(tiny, bicubic, 0.25)
    state = upscaler.initial_state(HEIGHT, WIDTH)
    upscaler.step(texture(0), state)
    with pytest.raises(ValueError, match="consumed"):
        upscaler.step(texture(0), state)
    with pytest.raises(ValueError, match="64x70"):
        upscaler.step(texture(0, 64, 70), upscaler.initial_state(70, 64))


def test_what_cannot_work_is_refused(model_file: ModelFile, tiny: Spy, bicubic: Spy) -> None:
    for share in (0, 1, -0.5, float("nan")):
        with pytest.raises(ValueError, match="not between 0 and 1"):
            DetailUpscaler(tiny, bicubic, share)
    with pytest.raises(ModelError, match="bicubic upscales by 3"):
        DetailUpscaler(tiny, OnnxUpscaler(find_model("bicubic", 3), threads=1), 0.5)
    with pytest.raises(ModelError, match="tiny does not say how far it reaches"):
        DetailUpscaler(OnnxUpscaler(model_file(), threads=1), bicubic, 0.5)
    with pytest.raises(ProviderError, match="--provider cpu"):
        DetailUpscaler(OnnxUpscaler(model_file(), provider="openvino", threads=1), bicubic, 0.5)
