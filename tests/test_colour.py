"""Colour and interpolation inside the graph: known colours, the place of chroma, flat areas, learned kernels."""

from __future__ import annotations

import pytest
import torch

from model.colour import PlanesToRgb, RgbToPlanes
from model.interpolation import KERNELS, Interpolation, LearnedInterpolation, chroma_shift

# 8-bit limited-range BT.709 codes of the 100% colour bars, as in SMPTE RP 219
BARS = [
    ((235, 128, 128), (1, 1, 1)),
    ((219, 16, 138), (1, 1, 0)),
    ((188, 154, 16), (0, 1, 1)),
    ((173, 42, 26), (0, 1, 0)),
    ((78, 214, 230), (1, 0, 1)),
    ((63, 102, 240), (1, 0, 0)),
    ((32, 240, 118), (0, 0, 1)),
    ((16, 128, 128), (0, 0, 0)),
]


def flat(codes: tuple[int, int, int]) -> list[torch.Tensor]:
    return [torch.full((1, 1, *size), float(code), dtype=torch.float64) for code, size in zip(codes, ((8, 8), (4, 4), (4, 4)), strict=True)]


@pytest.mark.parametrize(("codes", "rgb"), BARS)
def test_colour_bars_both_ways(codes: tuple[int, int, int], rgb: tuple[int, int, int]) -> None:
    found = PlanesToRgb()(*flat(codes))
    expected = torch.tensor(rgb, dtype=torch.float64)[:, None, None].expand(3, 8, 8)
    assert (found[0] - expected).abs().max() < 0.005  # half a code
    for plane, code in zip(RgbToPlanes()(expected[None]), codes, strict=True):
        assert (plane - code).abs().max() <= 0.51


def test_there_and_back_is_exact_where_chroma_is_linear() -> None:
    """Bilinear up, [1 2 1] down: a ramp comes back as it was, which a wrong siting would shift."""
    luma = torch.linspace(20, 230, 16 * 24, dtype=torch.float64).reshape(1, 1, 16, 24)
    ramp = (torch.arange(12, dtype=torch.float64) * 5 + 90).expand(1, 1, 8, 12) + torch.arange(8, dtype=torch.float64)[:, None]
    y, u, v = RgbToPlanes()(PlanesToRgb()(luma, ramp, 250 - ramp))
    inner = (..., slice(1, -1), slice(1, -1))
    torch.testing.assert_close(y, luma, rtol=0, atol=1e-4)
    torch.testing.assert_close(u[inner], ramp[inner], rtol=0, atol=1e-4)
    torch.testing.assert_close(v[inner], (250 - ramp)[inner], rtol=0, atol=1e-4)


@pytest.mark.parametrize("kernel", sorted(KERNELS))
@pytest.mark.parametrize("scale", [2, 3])
@pytest.mark.parametrize("block", [1, 2])
def test_cutting_into_cells_changes_nothing(kernel: str, scale: int, block: int) -> None:
    torch.manual_seed(0)
    plane = torch.rand(1, 1, 12, 16, dtype=torch.float64)
    shift = chroma_shift(scale)
    whole = torch.nn.functional.pixel_shuffle(Interpolation(kernel, scale, 1, shift)(plane), scale)
    cells = torch.nn.functional.pixel_shuffle(Interpolation(kernel, scale, block, shift)(plane), block * scale)
    torch.testing.assert_close(cells, whole)
    assert whole.shape == (1, 1, 12 * scale, 16 * scale)


def test_linear_and_bicubic_are_torchs() -> None:
    torch.manual_seed(0)
    plane = torch.rand(1, 1, 10, 14, dtype=torch.float64)
    for kernel, mode in (("linear", "bilinear"), ("bicubic", "bicubic")):
        for scale in (2, 3):
            found = torch.nn.functional.pixel_shuffle(Interpolation(kernel, scale)(plane), scale)
            expected = torch.nn.functional.interpolate(plane, scale_factor=scale, mode=mode, align_corners=False)
            torch.testing.assert_close(found, expected)


def test_a_learned_kernel_never_changes_a_flat_area_and_fuses_exactly() -> None:
    torch.manual_seed(0)
    learned = LearnedInterpolation("bicubic", 2, 2).double()
    plane = torch.rand(1, 1, 12, 16, dtype=torch.float64) * 255
    torch.testing.assert_close(learned(plane), Interpolation("bicubic", 2, 2)(plane))
    torch.nn.init.normal_(learned.correction)
    assert (learned(plane) - Interpolation("bicubic", 2, 2)(plane)).abs().max() > 1
    torch.testing.assert_close(learned(torch.full_like(plane, 77.0)), torch.full((1, 16, 6, 8), 77.0, dtype=torch.float64))
    torch.testing.assert_close(learned.fused()(plane), learned(plane))
