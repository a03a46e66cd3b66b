"""The networks: the paper's parameter counts, one module for frame and clip, causality, an untrained network is bicubic."""

from __future__ import annotations

import pytest
import torch

from model.complexity import parameter_count
from model.network import CELL_BOUND, PRESETS, ConvLstm, GameSR, NetworkConfig
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
        ("planes-static", 2, 288_472 + 1_700, 129_112 + 1_700),  # a norm's gain and offset are all of its parameters
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


@pytest.mark.parametrize("preset", ["planes", "paper"])
@pytest.mark.parametrize("scale", [2, 3])
def test_the_form_that_runs_gives_the_same_picture_to_the_border(preset: str, scale: int) -> None:
    network = random_network(preset, scale).double()
    clip = random_clip(1, 2, 16, 24)
    before, _ = network(clip)
    after, _ = network.deployed()(clip)
    for expected, found in zip(before, after, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


def test_a_planes_network_needs_an_even_unshuffle() -> None:
    with pytest.raises(ValueError, match="even unshuffle"):
        NetworkConfig(colour="planes", unshuffle=1)


def test_a_cell_that_never_forgets_grows_by_one_a_frame_up_to_the_bound() -> None:
    lstm = ConvLstm(2)
    with torch.no_grad():
        lstm.gates.weight.zero_()
        lstm.gates.bias.copy_(torch.tensor([100.0, 100, 100, 100, 0, 0, 100, -100]))  # all let in, nothing forgotten; one up, one down
        x = torch.zeros(1, 2, 3, 3)
        state = State(x, x)
        for step in range(1, 41):
            state = lstm(x, state)
            grown = torch.full((1, 1, 3, 3), min(step, CELL_BOUND))
            assert torch.equal(state.c, torch.cat((grown, -grown), 1))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_a_lost_cell_is_not_hidden_by_its_bound(bad: float) -> None:
    state = State(*(torch.zeros(1, 2, 3, 3) for _ in range(2)))
    state.c[0, 1, 2, 0] = bad
    found = ConvLstm(2)(torch.zeros(1, 2, 3, 3), state).c.isfinite()
    assert not found[0, 1, 2, 0] and found.sum() == found.numel() - 1
