"""BD-rate and savings: published examples, what must hold of any curve, and a reason wherever there is no number."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.bdrate import Curve, Figure, Undefined, bd_quality, bd_rate, bitrate_at, saving

# Rate and PSNR-Y of two classes of a JCT-VC contribution's spreadsheet, and its BD-rate, as the tests of libvmaf cite them
# (Netflix/vmaf, python/test/bd_rate_calculator_test.py, BDrateCalculatorJCTVCTest).
JCTVC = [
    (
        [(108048.8736, 43.6471), (61279.976, 40.3953), (33905.6656, 37.247), (18883.6928, 34.2911)],
        [(108061.2784, 43.6768), (61299.9936, 40.4232), (33928.7472, 37.2761), (18910.912, 34.3147)],
        -0.465215420752807,
    ),
    (
        [(40433.8848, 37.5761), (7622.7456, 35.3756), (2394.488, 33.8977), (1017.6184, 32.0603)],
        [(40370.12, 37.5982), (7587.0024, 35.4025), (2390.0944, 33.9194), (1017.0984, 32.0822)],
        -1.8779823450567612,
    ),
]


def curve(points: list[tuple[float, float]], name: str = "ours") -> Curve:
    return Curve.through(name, "VMAF", points)


def number(figure: Figure) -> float:
    assert not isinstance(figure, Undefined), figure.reason
    return figure


def reason(figure: Figure) -> str:
    assert isinstance(figure, Undefined)
    return figure.reason


@pytest.mark.parametrize(("anchor", "test", "expected"), JCTVC)
def test_bd_rate_is_that_of_the_spreadsheet(anchor: list[tuple[float, float]], test: list[tuple[float, float]], expected: float) -> None:
    assert number(bd_rate(curve(anchor), curve(test))) == pytest.approx(expected, abs=1e-9)


def test_bd_rate_where_curves_share_little() -> None:
    """An example that Intel's media delivery image checks libvmaf's calculator with: 23% and a fraction."""
    anchor, test = [(35, 21), (37, 25), (39, 28), (42, 30)], [(49, 28), (52, 32), (55, 35), (58, 37)]
    assert math.floor(number(bd_rate(curve(anchor), curve(test)))) == 23


@st.composite
def curves(draw: st.DrawFn) -> Curve:
    """Strictly rising, 4 to 8 points, bitrates of 500 to some 100,000 kbps, qualities of 20 to 100, all of them sharing 40 to 45."""
    count = draw(st.integers(4, 8))
    rates, rate = [], draw(st.floats(500, 3000))
    for _ in range(count):
        rates.append(rate)
        rate *= draw(st.floats(1.1, 2))
    steps = draw(st.lists(st.floats(0.2, 1), min_size=count - 1, max_size=count - 1))
    low, high = draw(st.floats(20, 40)), draw(st.floats(45, 100))
    qualities = [low + (high - low) * sum(steps[:index]) / sum(steps) for index in range(count)]
    return curve(list(zip(rates, qualities, strict=True)))


def scaled(of: Curve, factor: float) -> Curve:
    return curve([(factor * rate, quality) for rate, quality in zip(of.bitrates_kbps, of.qualities, strict=True)], "scaled")


@given(curves())
def test_a_curve_saves_nothing_over_itself(of: Curve) -> None:
    assert number(bd_rate(of, of)) == pytest.approx(0, abs=1e-9)
    assert number(bd_quality(of, of)) == pytest.approx(0, abs=1e-9)
    assert number(saving(of, of, 42)) == pytest.approx(0, abs=1e-9)


@given(curves(), st.floats(0.2, 5))
def test_the_same_curve_at_k_times_the_bitrate_costs_k_times_the_bits(of: Curve, factor: float) -> None:
    assert number(bd_rate(of, scaled(of, factor))) == pytest.approx(100 * (factor - 1), abs=1e-6)
    assert number(saving(of, scaled(of, factor), 42)) == pytest.approx(100 * (1 - factor), abs=1e-6)


@given(curves(), st.floats(-5, 5))
def test_bd_quality_is_what_was_added(of: Curve, more: float) -> None:
    better = curve([(rate, quality + more) for rate, quality in zip(of.bitrates_kbps, of.qualities, strict=True)])
    assert number(bd_quality(of, better)) == pytest.approx(more, abs=1e-6)


@given(curves(), curves())
def test_there_and_back_cancel_in_the_logarithm(one: Curve, other: Curve) -> None:
    there, back = number(bd_rate(one, other)), number(bd_rate(other, one))
    assert (1 + there / 100) * (1 + back / 100) == pytest.approx(1)
    quality = bd_quality(one, other)
    if not isinstance(quality, Undefined):
        assert number(bd_quality(other, one)) == pytest.approx(-quality)


@given(curves(), st.data())
def test_the_bitrate_at_a_quality_lies_between_its_neighbours(of: Curve, data: st.DataObject) -> None:
    for rate, quality in zip(of.bitrates_kbps, of.qualities, strict=True):
        assert number(bitrate_at(of, quality)) == pytest.approx(rate)
    index = data.draw(st.integers(1, len(of.qualities) - 1))
    quality = data.draw(st.floats(of.qualities[index - 1], of.qualities[index]))
    low, high = of.bitrates_kbps[index - 1 : index + 1]
    assert low * (1 - 1e-9) <= number(bitrate_at(of, quality)) <= high * (1 + 1e-9)


GOOD = curve([(2000, 60.0), (4000, 70.0), (8000, 80.0), (16000, 90.0)], "native")


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([(2000, 60), (4000, 70), (8000, 80)], "ours has 3 points, fewer than 4"),
        (
            [(2000, 60), (4000, 75), (8000, 74.5), (16000, 90)],
            "ours is not monotone: VMAF falls from 4000 kbps to 8000 kbps (75.000, 74.500)",
        ),
        ([(2000, 60), (4000, 95), (8000, 100), (16000, 100)], "ours is saturated: VMAF stays at 100.0 from 8000 kbps to 16000 kbps"),
        ([(2000, 60), (4000, 70), (7000, 80), (7000, 80)], "ours is saturated: two of its points have 7000 kbps"),
    ],
)
def test_a_curve_that_is_none_gives_its_reason(points: list[tuple[float, float]], expected: str) -> None:
    ours = curve(points)
    assert reason(bitrate_at(ours, 70)) == expected
    for figure in (bd_rate(GOOD, ours), bd_rate(ours, GOOD), bd_quality(GOOD, ours), saving(GOOD, ours, 70), saving(ours, GOOD, 70)):
        assert reason(figure) == expected


def test_a_curve_with_a_point_that_has_no_quality_gives_the_reason() -> None:
    holed = Curve.through("ours", "PSNR-Y", [(2000, 30.0), (4000, 35.0), (8000, 38.0), (16000, 40.0)], missing="identical at 32000 kbps")
    assert reason(bitrate_at(holed, 36)) == reason(bd_rate(GOOD, holed)) == "ours has no PSNR-Y: identical at 32000 kbps"


def test_what_two_curves_do_not_share_is_no_number() -> None:
    above = curve([(2000, 90.0), (4000, 92.0), (8000, 94.0), (16000, 96.0)])
    assert reason(bd_rate(GOOD, above)) == "no overlap: native has VMAF 60.0 to 90.0, ours has VMAF 90.0 to 96.0"
    beyond = curve([(20000, 60.0), (40000, 70.0), (80000, 80.0), (160000, 90.0)])
    assert reason(bd_quality(GOOD, beyond)) == "no overlap: native has 2000 to 16000 kbps, ours has 20000 to 160000 kbps"


def test_a_quality_outside_of_a_curve_is_not_extrapolated() -> None:
    assert reason(bitrate_at(GOOD, 95)) == "native never reaches VMAF 95 (90.0 at 16000 kbps)"
    assert reason(bitrate_at(GOOD, 50)) == "native is above VMAF 50 from its lowest bitrate on (60.0 at 2000 kbps)"
    low = curve([(2000, 20.0), (4000, 30.0), (8000, 40.0), (16000, 45.0)])
    assert reason(saving(GOOD, low, 70)) == reason(saving(low, GOOD, 70)) == "ours never reaches VMAF 70 (45.0 at 16000 kbps)"
