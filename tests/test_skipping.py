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

from client.frames import Frame
from client.models import find_model
from client.skipping import SkippingState, SkippingUpscaler
from client.upscaler import OnnxUpscaler, State
from model.export import export_network
from tests.networks import random_network

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


def same(a: Frame, b: Frame) -> bool:
    return all(np.array_equal(p, q) for p, q in zip((a.y, a.u, a.v), (b.y, b.u, b.v), strict=True))


class Spy(OnnxUpscaler):
    """Writes down the size of every frame or window that goes through the session."""

    def __init__(self, model: Path) -> None:
        super().__init__(model, threads=1)
        self.sizes: list[tuple[int, int]] = []

    def step(self, frame: Frame, state: State) -> tuple[Frame, State]:
        self.sizes.append((frame.height, frame.width))
        return super().step(frame, state)

    def taken(self) -> list[tuple[int, int]]:
        sizes, self.sizes = self.sizes, []
        return sizes


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("artifacts")
    for preset, scale in (("live", 2), ("live", 3), ("planes", 2)):
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


def whole(upscaler: OnnxUpscaler, frame: Frame) -> Frame:
    return upscaler.step(frame, upscaler.initial_state(frame.height, frame.width))[0]


EXACT = ["bicubic_x2", "bicubic_x3", "lanczos_x2", "lanczos_x3", "live_x2", "live_x3"]


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
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(frames=clips())
def test_without_a_state_skipping_changes_no_bit(spies: dict[str, Spy], name: str, frames: list[Frame]) -> None:
    """Also the frame in which a tile wakes up."""
    steps = through(SkippingUpscaler(spies[name]), frames)
    assert all(same(picture, whole(spies[name], frame)) for frame, (picture, _) in zip(frames, steps, strict=True))
