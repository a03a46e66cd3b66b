"""A sweep's points as curves, clip by clip, and what each of them saves over native resolution and over bicubic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from server.bdrate import Curve, Figure, bd_quality, bd_rate, saving
from server.points import NO_UPSCALER, PointResult

METRICS = {"vmaf": "VMAF", "vmaf_neg": "VMAF-NEG", "psnr_y_db": "PSNR-Y"}
GRADES = {70: "fair", 80: "good", 90: "excellent"}  # what VMAF is taken for
BASELINE = "bicubic"


def label(upscaler: str) -> str:
    """What people call it: no upscaler is native resolution."""
    return "native" if upscaler == NO_UPSCALER else upscaler


@dataclass(frozen=True)
class Series:
    """The points of one upscaler at one height of one clip, by rising bitrate."""

    upscaler: str
    low_height: int
    results: tuple[PointResult, ...]

    @property
    def label(self) -> str:
        return label(self.upscaler)

    @property
    def name(self) -> str:
        return f"{self.label} {self.low_height}p"

    def curve(self, metric: str) -> Curve:
        """Its curve over the true bitrate; `metric` is one of METRICS."""
        points = [(result.bitrate_kbps, getattr(result.quality, metric)) for result in self.results]
        reasons = [f"{r.quality.undefined[metric]} at {r.bitrate_kbps:.0f} kbps" for r in self.results if metric in r.quality.undefined]
        return Curve.through(self.name, METRICS[metric], [p for p in points if p[1] is not None], reasons[0] if reasons else None)


@dataclass(frozen=True)
class Comparison:
    """What one series buys over another of the same clip: BD figures by metric, bits saved by VMAF."""

    series: Series
    anchor: Series
    bd_rate_percent: dict[str, Figure]
    bd_quality: dict[str, Figure]
    saving_percent: dict[int, Figure]


def series_by_clip(results: Sequence[PointResult]) -> dict[str, list[Series]]:
    """Every clip's series, in the order in which their points come."""
    found: dict[str, dict[tuple[str, int], list[PointResult]]] = {}
    for result in results:
        point = result.point
        found.setdefault(point.clip, {}).setdefault((point.upscaler, point.low_height), []).append(result)
    return {
        clip: [Series(*key, tuple(sorted(points, key=lambda result: result.bitrate_kbps))) for key, points in of_clip.items()]
        for clip, of_clip in found.items()
    }


def anchors(series: Series, of_clip: Sequence[Series]) -> list[Series]:
    """What a series is held against: native resolution, and bicubic at its own height."""
    return [
        other
        for other in of_clip
        if other != series
        and series.upscaler != NO_UPSCALER
        and (other.upscaler == NO_UPSCALER or (other.upscaler, other.low_height) == (BASELINE, series.low_height))
    ]


def compare(series: Series, anchor: Series) -> Comparison:
    curves = {metric: (anchor.curve(metric), series.curve(metric)) for metric in METRICS}
    return Comparison(
        series,
        anchor,
        {metric: bd_rate(*pair) for metric, pair in curves.items()},
        {metric: bd_quality(*pair) for metric, pair in curves.items()},
        {quality: saving(*curves["vmaf"], quality) for quality in GRADES},
    )
