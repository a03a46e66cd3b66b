"""Pictures of a sweep: the same every time, all curves and lines there, names that do not touch."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from server.plots import _apart, latency_figure, over_time_figure, rd_figures, rendered
from server.points import PointResult
from server.viewing import View, Viewing
from tests.measured import latency_results, point_result, sweep_results, with_quality


def svg_of(name: str, points: list[PointResult]) -> str:
    return rendered(dict(rd_figures(points))[name], "svg").decode()


def test_a_figure_for_every_metric_and_height() -> None:
    names = [name for name, _ in rd_figures(sweep_results(("map",)))]
    assert names == [f"rd_{metric}_{height}p" for metric in ("vmaf", "vmaf_neg", "psnr_y") for height in (540, 360)]


def test_every_curve_grade_and_clip_is_there() -> None:
    svg = svg_of("rd_vmaf_540p", sweep_results())
    ET.fromstring(svg)
    for text in ("native", "bicubic", "lanczos", "easu", "fsr1", "gamesr", "fair 70", "good 80", "excellent 90"):
        assert svg.count(f"<!-- {text} -->") == 2, text
    assert "<!-- map, 540p to 1080p -->" in svg and "<!-- track, 540p to 1080p -->" in svg
    assert "<!-- fair 70 -->" not in svg_of("rd_psnr_y_540p", sweep_results(("map",), (540,)))


def test_the_same_points_give_the_same_files() -> None:
    points, latencies = sweep_results(("map",), (540,)), latency_results(("map",))
    for kind in ("svg", "png"):
        first, again = (rendered(next(rd_figures(points))[1], kind) for _ in range(2))
        assert first == again
        assert rendered(latency_figure(latencies), kind) == rendered(latency_figure(latencies), kind)


def test_a_png_is_wide_enough_to_read() -> None:
    picture = Image.open(io.BytesIO(rendered(next(rd_figures(sweep_results()))[1], "png")))
    assert picture.width > 1500


def test_latency_shows_both_deadlines_and_every_upscaler() -> None:
    svg = rendered(latency_figure(latency_results(("map",))), "svg").decode()
    for text in ("60 fps", "120 fps", "native 1080p", "fsr1 360p", "2.1 / 3.0"):
        assert f"<!-- {text} -->" in svg, text


def test_a_figure_that_no_point_has_leaves_its_panels_empty() -> None:
    points = sweep_results(("map",), (540,))
    bare = [
        with_quality(point, vmaf=None, vmaf_neg=None, undefined={"vmaf": "not asked for", "vmaf_neg": "not asked for"}) for point in points
    ]
    assert "<!-- gamesr -->" not in svg_of("rd_vmaf_540p", bare)


def test_a_panel_for_the_clips_that_have_the_height_whatever_they_are_called() -> None:
    points = [*sweep_results(("map",), (540,)), *sweep_results(("a$b_{$c",), (360,))]
    svg = svg_of("rd_vmaf_360p", points)
    assert "<!-- a$b_{$c, 360p to 1080p -->" in svg and "<!-- map" not in svg


def test_native_alone_has_no_figure() -> None:
    assert list(rd_figures([point_result("map", "none", 1080, 2000)])) == []


@given(st.lists(st.floats(0, 100), min_size=1, max_size=12).map(sorted), st.floats(0.5, 10))
def test_names_keep_their_order_their_distance_and_below_the_top(wanted: list[float], step: float) -> None:
    places = _apart(wanted, step, top=100.0)
    assert len(places) == len(wanted) and max(places) <= 100 + 1e-6
    assert all(after - before >= step - 1e-6 for before, after in pairwise(places))
    if all(after - before >= step for before, after in pairwise(wanted)):
        assert places == pytest.approx(wanted)
    assert sum(_apart(wanted, step, top=1000.0)) == pytest.approx(sum(wanted))


def test_time_is_shaded_where_the_picture_was_not_clean() -> None:
    clean, damaged, frozen = View.CLEAN, View.DAMAGED, View.FROZEN
    errors = {"bicubic": [4.0, 9, 0, 16, 4, 4], "gamesr": [2.0, 8, 0, 20, 3, 3]}  # 0: identical, which no curve reaches
    seen = Viewing(60, 90, 3, 1, [clean, damaged, damaged, frozen, damaged, clean], errors)
    first, again = (rendered(over_time_figure({"IDR, 2%": seen, "intra, 2%": seen}), "svg") for _ in range(2))
    svg = first.decode()
    assert first == again and svg.count("<!-- bicubic -->") == svg.count("<!-- gamesr -->") == 2
    assert "<!-- IDR, 2% -->" in svg
    assert svg.count("fill: #e69f00; opacity: 0.25") == 4 and svg.count("fill: #767676; opacity: 0.5") == 2  # two runs and one, a panel
