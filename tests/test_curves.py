"""From points to curves: which belong together, what they are held against, and what a missing figure does."""

from __future__ import annotations

from server.bdrate import Undefined
from server.curves import anchors, compare, series_by_clip
from tests.measured import BITRATES_KBPS, sweep_results, with_quality


def test_points_become_one_series_an_upscaler_and_height_of_a_clip() -> None:
    clips = series_by_clip(list(reversed(sweep_results())))
    assert list(clips) == ["track", "map"]
    names = {series.name for series in clips["map"]}
    assert len(names) == 11 and {"native 1080p", "bicubic 540p", "fsr1 360p"} <= names
    for series in clips["map"]:
        assert [result.point.requested_kbps for result in series.results] == list(BITRATES_KBPS)
        assert all((r.point.clip, r.point.upscaler) == ("map", series.upscaler) for r in series.results)


def test_each_is_held_against_native_and_against_bicubic_of_its_own_height() -> None:
    of_clip = series_by_clip(sweep_results())["map"]
    against = {series.name: [other.name for other in anchors(series, of_clip)] for series in of_clip}
    assert against["native 1080p"] == []
    assert against["bicubic 360p"] == ["native 1080p"]
    assert against["gamesr 360p"] == ["native 1080p", "bicubic 360p"]
    assert against["gamesr 540p"] == ["native 1080p", "bicubic 540p"]


def test_a_better_upscaler_takes_fewer_bits_and_gains_quality() -> None:
    of_clip = {series.name: series for series in series_by_clip(sweep_results())["map"]}
    found = compare(of_clip["gamesr 540p"], of_clip["bicubic 540p"])
    for metric in ("vmaf", "vmaf_neg", "psnr_y_db"):
        rate, quality = found.bd_rate_percent[metric], found.bd_quality[metric]
        assert not isinstance(rate, Undefined) and not isinstance(quality, Undefined)
        assert rate < -5 and quality > 0.5
    at_70, at_90 = found.saving_percent[70], found.saving_percent[90]
    assert not isinstance(at_70, Undefined) and at_70 > 5
    assert isinstance(at_90, Undefined) and "gamesr 540p never reaches VMAF 90" in at_90.reason


def test_a_figure_that_a_point_lacks_is_the_reason_for_its_curve() -> None:
    results = sweep_results(("map",), (540,))
    results[-1] = with_quality(results[-1], psnr_y_db=None, undefined={"psnr_y_db": "identical"})
    of_clip = {series.name: series for series in series_by_clip(results)["map"]}
    found = compare(of_clip["gamesr 540p"], of_clip["bicubic 540p"])
    assert found.bd_rate_percent["psnr_y_db"] == Undefined("gamesr 540p has no PSNR-Y: identical at 25500 kbps")
    assert not isinstance(found.bd_rate_percent["vmaf"], Undefined)
