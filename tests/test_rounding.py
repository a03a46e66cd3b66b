"""Training for 8 bits: noise no wider than a step, ranges that can be learned, nothing left behind, and other networks refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from client.errors import InputError
from model.calibration import MADE, MADE_FRAMES
from model.footage import FootageCache
from model.lean import Lean, LeanConfig
from model.planes import Planes
from model.rounding import STEPS, RoundedFeatures
from model.train import TrainConfig, Trainer
from tests.moving import write_footage
from tests.networks import random_clip, random_network


@pytest.fixture
def network() -> Lean:
    torch.manual_seed(0)
    network = Lean(LeanConfig(channels=8, expanded=8, blocks=1, carried=False))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return network


def features_of(network: Lean, clip: Planes) -> torch.Tensor:
    """What the last block gives, hooks before this one included."""
    seen: list[torch.Tensor] = []
    hook = network.blocks[-1].register_forward_hook(lambda module, inputs, features: seen.append(features))
    network(clip)
    hook.remove()
    return torch.stack(seen)


def test_an_error_is_at_most_half_a_step_of_the_channels_range_over_clip_and_made_frames(network: Lean) -> None:
    clip = Planes(*(plane.float() for plane in random_clip(1, 2, 16, 24)))
    rounded = RoundedFeatures(network, 0)
    exact = features_of(network, clip)
    made = []
    for make, width, height in MADE:
        frame = list(make(width, height, MADE_FRAMES))[3]
        made.append(features_of(network, Planes(*(torch.from_numpy(p).float()[None, None, None] for p in (frame.y, frame.u, frame.v)))))
    with rounded(3):
        error = (features_of(network, clip) - exact).abs().amax((0, 1, 3, 4))
    every = [exact, *made]
    highest = torch.stack([features.amax((0, 1, 3, 4)) for features in every]).amax(0)
    lowest = torch.stack([features.amin((0, 1, 3, 4)) for features in every]).amin(0)
    half_a_step = (highest - lowest) / STEPS / 2
    assert (error <= half_a_step * 1.001).all() and (error > half_a_step * 0.9).all()
    torch.testing.assert_close(features_of(network, clip), exact, rtol=0, atol=0)


def test_in_a_flat_area_a_channel_is_off_by_the_same_everywhere_and_by_another_code_in_each_step(network: Lean) -> None:
    grey = Planes(*(torch.full(shape, 128.0) for shape in ((1, 2, 1, 16, 24), (1, 2, 1, 8, 12), (1, 2, 1, 8, 12))))
    exact, rounded = features_of(network, grey), RoundedFeatures(network, 0)
    errors = []
    for index in (0, MADE_FRAMES):  # with the same made frames
        with rounded(index):
            errors.append(features_of(network, grey) - exact)
    for error in errors:
        torch.testing.assert_close(error, error[:1, :1, :, :1, :1].expand_as(error), rtol=0, atol=1e-6)
    assert (errors[0] - errors[1]).abs().amax() > 1e-4


def test_where_the_codes_lie_is_a_function_of_seed_and_step(network: Lean) -> None:
    """A run that is resumed draws what it would have drawn."""
    clip = Planes(*(plane.float() for plane in random_clip(1, 1, 8, 8)))

    def rounded(seed: int, index: int) -> torch.Tensor:
        with RoundedFeatures(network, seed)(index):
            return features_of(network, clip)

    first = rounded(0, 3)
    torch.testing.assert_close(rounded(0, 3), first, rtol=0, atol=0)
    assert not torch.equal(rounded(1, 3), first) and not torch.equal(rounded(0, 3 + MADE_FRAMES), first)


def test_what_made_frames_reach_has_a_gradient(network: Lean) -> None:
    """A grey clip alone would leave a kernel of differences without one."""
    grey = Planes(*(torch.full(shape, 128.0) for shape in ((1, 1, 1, 16, 24), (1, 1, 1, 8, 12), (1, 1, 1, 8, 12))))
    with RoundedFeatures(network, 1)(0):
        picture, _ = network(grey)
    (picture.y - 100).square().mean().backward()
    stem = network.stem.weight.grad
    assert stem is not None
    across = stem - stem.mean((2, 3), keepdim=True)
    assert across.abs().max() > 0


def test_an_error_inside_leaves_nothing_rounded_behind(network: Lean) -> None:
    clip = Planes(*(plane.float() for plane in random_clip(1, 1, 8, 8)))
    exact = features_of(network, clip)
    with pytest.raises(ZeroDivisionError), RoundedFeatures(network, 0)(0):
        raise ZeroDivisionError
    torch.testing.assert_close(features_of(network, clip), exact, rtol=0, atol=0)


@pytest.mark.parametrize("preset", ["planes", "paper", "srvgg"])
def test_a_network_without_such_features_is_refused(preset: str) -> None:
    with pytest.raises(InputError, match="only fast, live and balanced, wide or not, can be trained for 8 bits"):
        RoundedFeatures(random_network(preset), 0)


def test_a_run_for_8_bits_trains_and_says_so(tmp_path: Path) -> None:
    footage, cache = write_footage(tmp_path), FootageCache(tmp_path / "cache")
    tiny = {"preset": "fast", "degradations": ("area",), "steps": 4, "batch": 2, "patch": 16, "frames": 4, "window": 2, "warm_up_steps": 2}
    losses = [list(Trainer(TrainConfig(**tiny, int8=int8), footage, cache, tmp_path / f"{int8}").losses()) for int8 in (True, False)]
    assert len(losses[0]) == 4 and losses[0] != losses[1]
