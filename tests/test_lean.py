"""The live tiers' network: what runs is plain convolutions, and gives what was trained, to the border; flat areas stay flat in bfloat16."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.complexity import parameter_count
from model.lean import CELL, LEAN, FlatInterpolation, Lean, LeanConfig
from model.network import GameSR, NetworkConfig
from model.planes import Planes
from tests.networks import random_clip, random_network

BFLOAT16_EXACT = 256  # integers up to this


@pytest.mark.parametrize(
    ("preset", "scale", "training", "running"),
    [
        ("fast", 2, 44_028, 7_976),
        ("live", 2, 48_028, 17_944),
        ("live", 3, 55_843, 26_614),
        ("live-wide", 2, 50_428, 19_240),
        ("balanced", 2, 54_428, 33_816),
        ("balanced", 3, 66_563, 46_806),
        ("balanced-wide", 2, 56_828, 35_112),
    ],
)
def test_parameter_counts(preset: str, scale: int, training: int, running: int) -> None:
    network = random_network(preset, scale)
    assert parameter_count(network) == training
    assert parameter_count(network.deployed()) == running


@pytest.mark.parametrize("preset", LEAN)
@pytest.mark.parametrize("scale", [2, 3])
@pytest.mark.parametrize("size", [(2, 2), (16, 24)])
def test_the_form_that_runs_gives_the_same_picture_to_the_border(preset: str, scale: int, size: tuple[int, int]) -> None:
    network = random_network(preset, scale).double()
    clip = random_clip(1, 2, *size)
    before, _ = network(clip)
    after, _ = copy.deepcopy(network).deployed()(clip)
    for expected, found in zip(before, after, strict=True):
        assert found.shape[3:] == (expected.shape[3], expected.shape[4])
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [2, 3])
def test_a_clip_equals_frame_by_frame(scale: int) -> None:
    network = random_network("live", scale).double()
    clip = random_clip(2, 3, 8, 12)
    whole, state = network(clip)
    assert state is None
    for t in range(3):
        picture, _ = network.step(Planes(*(plane[:, t] for plane in clip)), None)
        for one, many in zip(picture, whole, strict=True):
            torch.testing.assert_close(one, many[:, t], rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [2, 3])
def test_untrained_it_is_bicubic_but_for_the_far_taps_of_chroma_and_for_rounding(scale: int) -> None:
    """What is cut off weighs little: a flat plane stays flat, and a slope of one code a sample stays within a quarter of a code."""
    network = Lean(LeanConfig(scale=scale)).double()
    whole = GameSR(NetworkConfig(scale=scale)).double()
    columns = torch.arange(16, dtype=torch.float64).expand(1, 1, 1, 8, 16)
    luma = random_clip(1, 1, 16, 32).y.double()
    for plane, tolerance in ((torch.full_like(columns, 77.0), 1e-2), (columns + 90, 0.25)):
        clip = Planes(luma, plane, plane)
        (lean, _), (full, _) = network(clip), whole(clip)
        torch.testing.assert_close(lean.y, full.y, rtol=0, atol=0.5)  # of white noise, the hardest there is for rounded weights
        assert (lean.y - full.y).square().mean().sqrt() < 0.2
        torch.testing.assert_close(lean.u, full.u, rtol=0, atol=tolerance)


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("scale", [2, 3])
def test_the_kernels_of_the_base_are_those_of_bfloat16_and_sum_to_one_there(block: int, scale: int) -> None:
    base = FlatInterpolation("bicubic", scale, block, reach=1)
    torch.manual_seed(0)
    with torch.no_grad():
        base.correction.normal_()
    kernel = base.kernel().detach().flatten(1)
    assert torch.equal(kernel, kernel.bfloat16().float())
    assert (kernel.double().sum(1) - 1).abs().max() < 1e-2 / 255
    bent = base.weight.float() + base.GAIN * (base.correction - base.correction.mean((1, 2, 3), keepdim=True))
    torch.testing.assert_close(kernel, bent.detach().flatten(1), rtol=2**-8, atol=2e-2)


def test_training_bends_the_kernels_through_the_rounding() -> None:
    base = FlatInterpolation("bicubic", 2, 2, reach=1)
    plane = random_clip(1, 1, 8, 8).y[:, 0].float()
    base(plane)[:, 0].sum().backward()
    assert base.correction.grad is not None and base.correction.grad[0].abs().max() > 0


def test_what_runs_is_a_row_of_convolutions_that_pad_nothing_and_hand_the_cells_on() -> None:
    network = random_network("live").deployed()
    assert isinstance(network, Lean)
    layers = [network.stem, *network.blocks, network.head]
    assert {type(layer) for layer in layers} == {nn.Conv2d} and {layer.padding for layer in layers} == {(0, 0)}
    assert [layer.in_channels for layer in layers] == [CELL, *[32] * 2]
    x = torch.randint(0, BFLOAT16_EXACT, (1, CELL, 20, 20)).bfloat16()
    cells = x
    for cut, layer in enumerate(layers[:-1], 1):
        x = F.leaky_relu(layer.bfloat16()(x), 0.1)
        assert torch.equal(x[:, -CELL:], cells[:, :, cut:-cut, cut:-cut])


@pytest.mark.parametrize("scale", [2, 3])
def test_a_flat_picture_is_flat_at_every_code_where_the_base_runs_in_bfloat16(scale: int) -> None:
    """The untrained residual is zero, so that the picture is the base alone; sums of a runtime are in float32, as here."""
    network = Lean(LeanConfig(scale=scale)).deployed()
    weight = network.head.weight.detach().bfloat16().float()
    for code in (0, 16, 127, 235, 255):
        cells = torch.cat((torch.zeros(1, network.config.features, 3, 3), torch.full((1, CELL, 3, 3), float(code))), 1)
        picture: Tensor = F.conv2d(cells, weight, network.head.bias)
        assert (picture - code).abs().max() < 1e-2


@pytest.mark.parametrize("scale", [2, 3])
def test_what_cells_give_by_themselves_is_about_zero_where_bfloat16_is_fine(scale: int) -> None:
    """A runtime in bfloat16 rounds it before the features' part is added: of chroma within 16 codes of grey by a thirtieth of a code."""
    network = random_network("fast", scale).deployed().double()
    given: list[Tensor] = []
    network.chroma_head.cells.register_forward_hook(lambda module, inputs, samples: given.append(samples))
    clip = random_clip(1, 1, 32, 48)
    chroma = [120 + plane[:, 0] / 16 for plane in (clip.u, clip.v)]
    network.step(Planes(clip.y[:, 0], *chroma), None)
    bias = network.chroma_head.cells.bias.detach()[:, None, None]
    (samples,) = (x - bias for x in given)
    assert samples.abs().max() < 16
    assert (samples.bfloat16() - samples).abs().max() < 1 / 30
