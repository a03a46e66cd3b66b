"""The collapsed triple is the three convolutions: output to the border, gradients, and whole networks."""

from __future__ import annotations

import copy

import pytest
import torch

from model.reparam import LinearTriple, fuse
from tests.networks import random_clip, random_network


def triple(seed: int, dtype: torch.dtype) -> LinearTriple:
    torch.manual_seed(seed)
    module = LinearTriple(8, 16)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return module.to(dtype)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("size", [(1, 1), (2, 5), (9, 7)])
def test_fused_equals_unfused_on_every_pixel(seed: int, dtype: torch.dtype, bound: float, size: tuple[int, int]) -> None:
    module = triple(seed, dtype)
    x = torch.randn(2, 8, *size, dtype=dtype)
    unfused = module.forward_unfused(x)
    for fused in (module(x), module.fused()(x)):
        assert ((fused - unfused).abs().max() / unfused.abs().max()).item() <= bound


def cancelling_triple(gain: float) -> LinearTriple:
    """Half of the wide channels carry `gain` times something, the other half the same, and the last convolution subtracts them."""
    torch.manual_seed(4)
    module = LinearTriple(8, 16)
    a, b, last = torch.randn(3, 8, 8, 1, 1)
    middle = torch.randn(8, 8, 3, 3)
    with torch.no_grad():
        module.expand.weight.copy_(torch.cat((a + gain * b, gain * b)))
        module.middle.weight.zero_()
        module.middle.weight[:8, :8] = module.middle.weight[8:, 8:] = middle
        module.compress.weight.copy_(torch.cat((last, -last), 1))
    return module


@torch.no_grad()
@pytest.mark.parametrize("gain", [1.0, 1e3, 1e6])
def test_fused_in_float32_is_exact_where_large_weights_cancel(gain: float) -> None:
    """Because `fused` multiplies the weights in float64: the three convolutions in float32, and their product in it, lose what cancels."""
    module = cancelling_triple(gain)
    x = torch.randn(1, 8, 9, 7)
    exact = copy.deepcopy(module).double().forward_unfused(x.double())
    error = {
        form: ((y - exact).abs().max() / exact.abs().max()).item()
        for form, y in (("fused", module.fused()(x)), ("three", module.forward_unfused(x)))
    }
    assert error["fused"] < 2e-6
    assert gain == 1 or error["three"] > 100 * error["fused"]


def test_padding_after_the_expansion_would_be_wrong_on_the_border() -> None:
    module = triple(0, torch.float64)
    x = torch.randn(1, 8, 6, 6, dtype=torch.float64)
    wrong = module.compress(torch.nn.functional.conv2d(module.expand(x), module.middle.weight, module.middle.bias, padding=1))
    right = module(x)
    torch.testing.assert_close(wrong[..., 1:-1, 1:-1], right[..., 1:-1, 1:-1])
    assert (wrong - right).abs().max() > 0.1


def test_training_sees_the_gradients_of_the_unfused_form() -> None:
    module = triple(3, torch.float64)
    x = torch.randn(2, 8, 5, 6, dtype=torch.float64, requires_grad=True)
    gradients = []
    for forward in (module, module.forward_unfused):
        module.zero_grad()
        x.grad = None
        (forward(x) ** 3).sum().backward()
        gradients.append([x.grad, *(p.grad for p in module.parameters())])
    for collapsed, unfused in zip(*gradients, strict=True):
        torch.testing.assert_close(collapsed, unfused, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("preset", ["paper", "planes"])
def test_a_fused_network_gives_the_same_pictures(preset: str) -> None:
    network = random_network(preset).double()
    fused = fuse(copy.deepcopy(network))
    clip = random_clip(1, 4, 12, 16)
    for a, b in zip(network(clip)[0], fused(clip)[0], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-9)
    assert not any(isinstance(module, LinearTriple) for module in fused.modules())
