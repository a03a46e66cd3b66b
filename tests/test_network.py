"""The networks: the paper's parameter counts, one module for frame and clip, causality, an untrained network is bicubic."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from model.complexity import parameter_count
from model.network import PRESETS, GameSR, MergedHead, NetworkConfig
from model.planes import Planes, State
from model.reparam import fuse
from tests.networks import random_clip, random_network


@pytest.mark.parametrize(
    ("preset", "scale", "training", "fused"),
    [
        ("paper", 2, 297_220, 137_860),  # the paper prints 298K and 138K
        ("paper-no-lstm", 2, 223_364, 64_004),  # 65K
        ("paper-no-unshuffle", 2, 284_224, 124_864),  # 125K
        ("paper", 3, 314_560, 155_200),
        ("planes-plain", 2, 288_472, 129_112),
        ("planes", 2, 288_472 + 1_700, 129_112 + 1_700),  # and the learned kernels under the residual
        ("planes", 3, 297_142 + 3_825, 137_782 + 3_825),
        ("live", 2, 91_548, 27_804),
        ("balanced", 2, 91_548 + 4 * 41_120, 27_804 + 4 * 9_248),
    ],
)
def test_parameter_counts(preset: str, scale: int, training: int, fused: int) -> None:
    network = GameSR(NetworkConfig(scale=scale, **PRESETS[preset]))
    assert parameter_count(network) == training
    assert parameter_count(fuse(network)) == fused


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize("scale", [2, 3])
def test_output_is_scale_times_the_input(preset: str, scale: int) -> None:
    network = random_network(preset, scale).double()
    clip = random_clip(1, 2, 8, 12)
    picture, _ = network(clip)
    assert picture.y.shape == (1, 2, 1, 8 * scale, 12 * scale)
    assert picture.u.shape == picture.v.shape == (1, 2, 1, 4 * scale, 6 * scale)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_clip_equals_frame_by_frame(preset: str) -> None:
    network = random_network(preset).double()
    clip = random_clip(2, 6, 16, 20)
    whole, last = network(clip)
    state = network.initial_state(2, 16, 20)
    for t in range(6):
        picture, state = network.step(Planes(*(p[:, t] for p in clip)), state)
        for one, many in zip(picture, whole, strict=True):
            torch.testing.assert_close(one, many[:, t], rtol=0, atol=1e-9)
    if isinstance(state, State):
        torch.testing.assert_close(state.c, last.c, rtol=0, atol=1e-9)


@pytest.mark.parametrize("preset", ["paper", "planes"])
def test_no_future_frame_changes_an_earlier_output_and_every_past_one_counts(preset: str) -> None:
    network = random_network(preset).double()
    clip = random_clip(1, 5, 16, 16)
    changed = Planes(*(p.clone() for p in clip))
    for plane in changed:
        plane[:, 3] = 255 - plane[:, 3]
    before, after = network(clip)[0], network(changed)[0]
    for a, b in zip(before, after, strict=True):
        assert torch.equal(a[:, :3], b[:, :3])
        assert not torch.equal(a[:, 4], b[:, 4])


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_an_untrained_network_is_bicubic(preset: str) -> None:
    torch.manual_seed(0)
    network = GameSR(NetworkConfig(**PRESETS[preset])).double()
    clip = random_clip(1, 1, 24, 32)
    picture, _ = network(clip)
    interpolate = torch.nn.functional.interpolate
    expected = interpolate(clip.y[:, 0], scale_factor=2, mode="bicubic", align_corners=False)
    torch.testing.assert_close(picture.y[:, 0], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("preset", ["live", "balanced", "planes"])
@pytest.mark.parametrize("scale", [2, 3])
def test_the_form_that_runs_gives_the_same_picture_to_the_border(preset: str, scale: int) -> None:
    network = random_network(preset, scale).double()
    clip = random_clip(1, 2, 16, 24)
    before, _ = network(clip)
    running = network.deployed()
    assert isinstance(running.head, MergedHead) == (preset != "planes")
    after, _ = running(clip)
    for expected, found in zip(before, after, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("scale", [2, 3])
def test_the_base_of_a_lean_network_is_bicubic_of_luma_and_of_chroma_with_the_far_taps_cut(scale: int) -> None:
    """What is cut off weighs little: a flat plane stays flat, and a slope of one code a sample stays within a quarter of a code."""
    network = GameSR(NetworkConfig(scale=scale, **PRESETS["live"])).double()
    whole = GameSR(NetworkConfig(scale=scale)).double()
    columns = torch.arange(16, dtype=torch.float64).expand(1, 1, 1, 8, 16)
    for plane, tolerance in ((torch.full_like(columns, 77.0), 1e-9), (columns + 90, 0.25)):
        clip = Planes(random_clip(1, 1, 16, 32).y.double(), plane, plane)
        (lean, _), (full, _) = network(clip), whole(clip)
        torch.testing.assert_close(lean.y, full.y, rtol=0, atol=1e-4)
        torch.testing.assert_close(lean.u, full.u, rtol=0, atol=tolerance)


def test_what_runs_of_a_lean_block_is_one_convolution() -> None:
    blocks = random_network("live", 2).deployed().blocks
    assert [[type(layer) for layer in block] for block in blocks] == [[nn.Conv2d, nn.LeakyReLU]] * 2


def test_a_lean_network_has_planes_and_a_learned_base() -> None:
    for wrong in ({"colour": "rgb"}, {"learned_base": False}):
        with pytest.raises(ValueError, match="a lean network is one of planes"):
            NetworkConfig(**{"lean": True, "learned_base": True, **wrong})


def test_a_planes_network_needs_an_even_unshuffle() -> None:
    with pytest.raises(ValueError, match="even unshuffle"):
        NetworkConfig(colour="planes", unshuffle=1)
