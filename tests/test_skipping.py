"""Unchanged tiles are not computed again: exact without a state, near with one, and nothing is missed when a tile wakes up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from client.errors import ModelError, ProviderError
from client.frames import Frame
from client.models import find_model
from client.pipeline import Restart, upscale_stream
from client.quality import squared_error
from client.sink import NullSink
from client.skipping import SETTLING_FRAMES, SkippingState, SkippingUpscaler
from client.tiles import TileGrid
from client.upscaler import OnnxUpscaler
from client.video import Decoded
from model.export import export_network
from tests.networks import random_network
from tests.stepping import Spy, same, whole

ModelFile = Callable[..., Path]
HEIGHT, WIDTH = 200, 264  # 7 x 9 tiles, the last ones cut off


def noise(seed: int, height: int = HEIGHT, width: int = WIDTH) -> Frame:
    rng = np.random.default_rng(seed)
    chroma = (-(-height // 2), -(-width // 2))
    y, u, v = (rng.integers(0, 256, shape, dtype=np.uint8) for shape in ((height, width), chroma, chroma))
    return Frame(y, u, v, seed, Fraction(1, 60))


def changed(frame: Frame, top: int, left: int, height: int, width: int, by: int = 1) -> Frame:
    """The frame with other code values in some luma rows and columns and in the chroma that lies over them."""
    y, u, v = frame.y.copy(), frame.u.copy(), frame.v.copy()
    y[top : top + height, left : left + width] += by
    for plane in (u, v):
        plane[top // 2 : (top + height) // 2, left // 2 : (left + width) // 2] += by
    return replace(frame, y=y, u=u, v=v)


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("artifacts")
    for preset, scale in (("live", 2), ("planes", 2)):
        export_network(random_network(preset, scale), folder / f"{preset}_x{scale}.onnx", name=preset, card={})
    baselines = {f"{name}_x{scale}": find_model(name, scale) for name in ("bicubic", "lanczos") for scale in (2, 3)}
    return baselines | {path.stem: path for path in folder.glob("*.onnx")}


@pytest.fixture(scope="module")
def spies(networks: dict[str, Path]) -> dict[str, Spy]:
    return {name: Spy(path) for name, path in networks.items()}


@pytest.fixture
def tiny(model_file: ModelFile) -> Spy:
    """The tiny recurrent model: h = gain * h + mean of 2x2, which looks at nothing around it."""
    return Spy(model_file(metadata={"reach": "0"}))


def through(upscaler: SkippingUpscaler, frames: list[Frame], state: SkippingState | None = None) -> Iterator[tuple[Frame, SkippingState]]:
    state = state or upscaler.initial_state(frames[0].height, frames[0].width)
    for frame in frames:
        picture, state = upscaler.step(frame, state)
        yield picture, state


EXACT = ["bicubic_x2", "bicubic_x3", "lanczos_x2", "lanczos_x3", "live_x2"]


@st.composite
def clips(draw: st.DrawFn) -> list[Frame]:
    """A few frames of any size, each the one before with some areas changed, wherever they are: none, one sample, all of it."""
    height, width = draw(st.integers(1, 150)), draw(st.integers(1, 150))
    frames = [noise(draw(st.integers(0, 9)), height, width)]
    for _ in range(draw(st.integers(1, 3))):
        frame = frames[-1]
        for _ in range(draw(st.integers(0, 3))):
            top, left = draw(st.integers(0, height - 1)), draw(st.integers(0, width - 1))
            side = draw(st.sampled_from([1, 2, 20, 150]))
            frame = changed(frame, top, left, side, side, draw(st.integers(1, 255)))
        frames.append(frame)
    return frames


@pytest.mark.parametrize("name", EXACT)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(frames=clips())
def test_without_a_state_skipping_changes_no_bit(spies: dict[str, Spy], name: str, frames: list[Frame]) -> None:
    """Also the frame in which a tile wakes up."""
    steps = through(SkippingUpscaler(spies[name]), frames)
    assert all(same(picture, whole(spies[name], frame)) for frame, (picture, _) in zip(frames, steps, strict=True))


def test_a_frame_equal_to_the_last_one_costs_no_run(spies: dict[str, Spy]) -> None:
    """Also with a state, at once, and also when the tiles have not settled: a game at 30 frames/s in a stream at 60."""
    for name in ("bicubic_x2", "planes_x2"):
        spy = spies[name]
        spy.taken()
        frames = [frame for seed in range(3) for frame in (noise(seed, 70, 90), replace(noise(seed, 70, 90), pts=100 + seed))]
        steps = list(through(SkippingUpscaler(spy), frames))
        assert spy.taken() == [(70, 90)] * 3
        assert [state.computed_share for _, state in steps] == [1, 0] * 3
        assert [picture.pts for picture, _ in steps] == [0, 100, 1, 101, 2, 102]
        assert all(same(steps[i][0], steps[i + 1][0]) for i in (0, 2, 4))


def test_repeated_frames_leave_the_memory_as_it_was(spies: dict[str, Spy]) -> None:
    """With each frame twice, every picture is bit for bit the one of the stream without the repeats."""
    frames = [noise(seed, 70, 90) for seed in range(4)]
    once = [picture for picture, _ in through(SkippingUpscaler(spies["planes_x2"]), frames)]
    twice = [picture for picture, _ in through(SkippingUpscaler(spies["planes_x2"]), [f for f in frames for _ in range(2)])]
    assert all(same(a, b) for a, b in zip(twice, [p for p in once for _ in range(2)], strict=True))


def test_full_motion_is_one_whole_run_a_frame_and_the_same_to_the_bit(spies: dict[str, Spy]) -> None:
    spy, frames = spies["planes_x2"], [noise(seed, 70, 90) for seed in range(4)]
    state, expected = OnnxUpscaler.initial_state(spy, 70, 90), []
    for frame in frames:
        picture, state = spy.step(frame, state)
        expected.append(picture)
    spy.taken()
    steps = list(through(SkippingUpscaler(spy), frames))
    assert spy.taken() == [(70, 90)] * 4
    assert all(same(picture, whole_picture) for (picture, _), whole_picture in zip(steps, expected, strict=True))


def test_in_full_motion_one_row_of_a_tile_tells(spies: dict[str, Spy], monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[bool] = []
    monkeypatch.setattr(TileGrid, "changed", lambda *planes: looked.append(True) or np.ones((7, 9), bool))
    frames = [noise(0), noise(1), noise(2), changed(noise(2), 0, 0, 3, 3)]
    assert [state.computed_share for _, state in through(SkippingUpscaler(spies["bicubic_x2"]), frames)] == [1] * 4
    assert looked == [True]


@pytest.mark.parametrize(("tiles", "in_motion"), [(42, False), (43, True)])
def test_motion_is_more_than_seven_eighths_of_the_whole_tiles(tiles: int, in_motion: bool) -> None:
    """Of 6x8; those that the frame cuts off are not looked at."""
    grid = TileGrid(HEIGHT, WIDTH, multiple=2, halo=4)
    before, after = noise(0).y, noise(0).y
    for tile in range(tiles):
        after[tile // 8 * 32 + 16, tile % 8 * 32] += 1
    assert grid.is_in_motion(before, after) is in_motion
    assert not TileGrid(20, 20, multiple=2, halo=4).is_in_motion(before[:20, :20], 255 - after[:20, :20])


@pytest.mark.parametrize("plane", ["u", "v"])
def test_what_changed_in_chroma_alone_is_seen(spies: dict[str, Spy], plane: str) -> None:
    """Whose rows no first look is taken at, after motion in which nothing else was."""
    frames = [noise(0), noise(1), replace(noise(1), **{plane: getattr(noise(2), plane)})]
    steps = list(through(SkippingUpscaler(spies["bicubic_x2"]), frames))
    assert all(same(picture, whole(spies["bicubic_x2"], frame)) for frame, (picture, _) in zip(frames, steps, strict=True))


@pytest.mark.parametrize(
    ("top", "left", "window"),
    [(0, 0, (36, 36)), (112, 112, (40, 40)), (198, 262, (44, 44)), (144, 0, (40, 36)), (31, 32, (68, 68))],
    ids=["corner", "inside", "last corner", "left edge", "a boundary"],
)
def test_one_changed_sample_costs_one_window_within_the_frame(spies: dict[str, Spy], top: int, left: int, window: tuple[int, int]) -> None:
    """Bicubic looks 4 pixels around: its tile of 32 with that halo, cut at the frame; or four tiles, where it is seen from all."""
    spy = spies["bicubic_x2"]
    frame = noise(0)
    state = next(through(SkippingUpscaler(spy), [frame]))[1]
    spy.taken()
    woken = changed(frame, top, left, 1, 1)
    picture, state = SkippingUpscaler(spy).step(woken, state)
    assert spy.taken() == [window]
    assert 0 < state.computed_share <= 4 / 63
    assert same(picture, whole(spy, woken)) and not same(picture, whole(spy, frame))


def test_a_change_of_chroma_alone_is_seen(spies: dict[str, Spy]) -> None:
    frame = noise(0, 33, 47)
    for plane in ("u", "v"):
        other = getattr(frame, plane).copy()
        other[-1, -1] ^= 1
        woken = replace(frame, **{plane: other})
        pictures = [picture for picture, _ in through(SkippingUpscaler(spies["bicubic_x2"]), [frame, woken])]
        assert same(pictures[1], whole(spies["bicubic_x2"], woken))


def test_a_window_of_a_recurrent_network_is_what_the_whole_frame_gives_there(spies: dict[str, Spy]) -> None:
    """Given one state, the picture of every tile that is computed is right to the bit; elsewhere it stays what it was."""
    upscaler = SkippingUpscaler(spies["planes_x2"], settling_frames=1)
    frames = [noise(0), changed(noise(0), 96, 128, 20, 20)]
    (first, _), (second, state) = list(through(upscaler, frames))
    expected = [picture for picture, _ in through(upscaler, [noise(0)])]
    full = spies["planes_x2"].initial_state(HEIGHT, WIDTH)
    for frame in frames:
        picture, full = spies["planes_x2"].step(frame, full)
        expected.append(picture)
    assert 0 < state.computed_share < 0.5
    touched = second.y != first.y
    assert touched.any() and np.array_equal(second.y[touched], expected[-1].y[touched])
    middle = (slice(2 * 96, 2 * 116), slice(2 * 128, 2 * 148))
    assert np.array_equal(second.y[middle], expected[-1].y[middle])
    assert np.array_equal(second.y[: 2 * 32], first.y[: 2 * 32])


def test_a_state_freezes_when_its_tile_has_settled_and_thaws_where_it_stood(tiny: Spy) -> None:
    """h = h / 2 + mean, and an eighth of h is in the picture: what it holds can be told from what is seen."""
    still = Frame(np.full((64, 64), 100, np.uint8), np.zeros((32, 32), np.uint8), np.zeros((32, 32), np.uint8))
    frames = [still]
    for index in range(1, 10):  # the right half moves, the left half stays
        frames.append(changed(frames[0], 0, 32, 64, 32, index))
    frames.append(changed(frames[-1], 0, 0, 64, 32, 50))
    steps = list(through(SkippingUpscaler(tiny, settling_frames=3), frames))
    left = [int(picture.y[0, 0]) for picture, _ in steps]
    held = [sum(100 * 0.5**k for k in range(n)) for n in (1, 2, 3)]  # h after one, two and three frames of 100
    expected = [int(0.875 * 100 + 0.125 * h) for h in held] + [int(0.875 * 100 + 0.125 * held[-1])] * 7
    assert left == [*expected, int(0.875 * 150 + 0.125 * (0.5 * held[-1] + 150))]
    assert [state.computed_share for _, state in steps] == [1, 1, 1] + [0.5] * 7 + [1]


@pytest.mark.parametrize("frames", [0, -1])
def test_a_tile_that_is_never_computed_is_refused(spies: dict[str, Spy], frames: int) -> None:
    with pytest.raises(ValueError, match="not 1 or more"):
        SkippingUpscaler(spies["planes_x2"], settling_frames=frames)


def test_a_still_settles_near_what_computing_all_gives(spies: dict[str, Spy]) -> None:
    spy = spies["planes_x2"]
    frames = [noise(0, 96, 96)] + [changed(noise(0, 96, 96), 0, 0, 2, 2, index) for index in range(1, 2 * SETTLING_FRAMES)]
    steps = list(through(SkippingUpscaler(spy), frames))
    assert [state.computed_share == 1 for _, state in steps] == [True] * SETTLING_FRAMES + [False] * SETTLING_FRAMES
    hasty = through(SkippingUpscaler(spy, settling_frames=1), frames)
    state, errors = spy.initial_state(96, 96), np.zeros(2)
    for frame, (picture, _), (early, _) in zip(frames, steps, hasty, strict=True):
        expected, state = spy.step(frame, state)
        errors += [squared_error(expected.y, picture.y), squared_error(expected.y, early.y)]
    assert 0 < errors[0] < errors[1] / 4


def test_a_state_lost_in_a_window_begins_again_everywhere(model_file: ModelFile) -> None:
    """With this gain the state overflows in the third frame that is computed: of the right half, while the left half is skipped."""
    spy = Spy(model_file(gain=1e30, metadata={"reach": "0"}))
    frames = [changed(noise(0, 64, 64), 0, 32, 64, 32, index) for index in range(3)]
    steps = list(through(SkippingUpscaler(spy, settling_frames=1), frames))
    assert [state.restarted for _, state in steps] == [False, False, True]
    assert [state.computed_share for _, state in steps] == [1, 0.5, 1]
    assert same(steps[2][0], whole(spy, frames[2]))


def test_a_state_is_consumed_and_a_copy_is_not(spies: dict[str, Spy]) -> None:
    upscaler = SkippingUpscaler(spies["planes_x2"])
    frames = [noise(0, 70, 90), changed(noise(0, 70, 90), 10, 10, 8, 8), noise(1, 70, 90)]
    state = upscaler.initial_state(70, 90)
    _, state = upscaler.step(frames[0], state)
    kept = state.copy()
    pictures = [picture for picture, _ in through(upscaler, frames[1:], state)]
    with pytest.raises(ValueError, match="consumed"):
        upscaler.step(frames[0], state)
    assert all(same(a, b) for a, (b, _) in zip(pictures, through(upscaler, frames[1:], kept), strict=True))
    with pytest.raises(ValueError, match="70x90"):
        upscaler.step(frames[0], upscaler.initial_state(90, 70))


def test_pictures_outlive_the_frames_after_them(spies: dict[str, Spy]) -> None:
    frames = [noise(0), changed(noise(0), 0, 0, 8, 8), changed(noise(0), 0, 0, 8, 8, 2)]
    pictures = [picture for picture, _ in through(SkippingUpscaler(spies["bicubic_x2"]), frames)]
    assert all(same(picture, whole(spies["bicubic_x2"], frame)) for picture, frame in zip(pictures, frames, strict=True))
    with pytest.raises(ValueError, match="read-only"):
        pictures[0].y[0, 0] = 1


def test_damage_clears_everything(tiny: Spy) -> None:
    """Where damage ends the pipeline asks for a new state, and then nothing is known to be unchanged."""
    still = noise(0, 64, 64)
    frames = [replace(still, damaged=index in (3, 4)) for index in range(8)]
    done = list(upscale_stream((Decoded(frame, 0, 0) for frame in frames), SkippingUpscaler(tiny), NullSink()))
    assert [d.restart for d in done] == [None] * 5 + [Restart.DAMAGE, None, None]
    assert [d.computed_share for d in done] == [1, 0, 0, 0, 0, 1, 0, 0]
    assert tiny.taken() == [(64, 64)] * 2


def test_a_cut_leaves_nothing_behind(spies: dict[str, Spy]) -> None:
    frames = [noise(0, 70, 90), changed(noise(0, 70, 90), 0, 0, 8, 8), noise(1, 70, 90)]
    *_, (picture, state) = through(SkippingUpscaler(spies["live_x2"]), frames)
    assert state.computed_share == 1 and same(picture, whole(spies["live_x2"], frames[-1]))


def test_a_model_that_does_not_say_its_reach_is_refused(model_file: ModelFile) -> None:
    with pytest.raises(ModelError, match="tiny does not say how far it reaches"):
        SkippingUpscaler(OnnxUpscaler(model_file(), threads=1))


def test_a_runtime_that_compiles_every_size_is_refused(model_file: ModelFile) -> None:
    with pytest.raises(ProviderError, match="--provider cpu"):
        SkippingUpscaler(OnnxUpscaler(model_file(), provider="openvino", threads=1))
