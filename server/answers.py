"""Results as the service answers with them: from points and latencies to the shapes of `server.schemas`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

from client.timing import LatencySummary
from server.bdrate import Figure as Number
from server.bdrate import Undefined, bitrate_at, saving
from server.curves import BASELINE, GRADES, METRICS, Series, anchors, compare, label, series_by_clip
from server.points import NO_UPSCALER, LatencyResult, PointResult
from server.schemas import (
    BdRate,
    BdRateList,
    ClipCurves,
    CurveList,
    CurvePoint,
    Deadline,
    Figure,
    Grade,
    LatencyList,
    MetricName,
    PointList,
    Quality,
    Saving,
    SavingList,
    SeriesName,
    StageLatency,
    SweepCurve,
    SweepLatency,
    SweepPoint,
    TargetMetricName,
)

_GRADED = get_args(TargetMetricName)


def point_list(sweep: str, results: Sequence[PointResult]) -> PointList:
    return PointList(sweep=sweep, points=[_point(result) for result in results])


def curve_list(sweep: str, results: Sequence[PointResult], metric: MetricName) -> CurveList:
    grades = [Grade(vmaf=vmaf, word=word) for vmaf, word in GRADES.items()] if metric in _GRADED else []
    clips = [
        ClipCurves(clip=clip, curves=[_curve(series, metric) for series in of_clip]) for clip, of_clip in series_by_clip(results).items()
    ]
    return CurveList(sweep=sweep, metric=metric, metric_label=METRICS[metric], grades=grades, clips=clips)


def bd_rate_list(sweep: str, results: Sequence[PointResult]) -> BdRateList:
    found = [
        _bd_rate(clip, series, anchor)
        for clip, of_clip in series_by_clip(results).items()
        for series in of_clip
        for anchor in anchors(series, of_clip)
    ]
    return BdRateList(sweep=sweep, bd_rates=found)


def saving_list(sweep: str, results: Sequence[PointResult], metric: TargetMetricName, target: float) -> SavingList:
    found = [_saving(clip, series, of_clip, metric, target) for clip, of_clip in series_by_clip(results).items() for series in of_clip]
    return SavingList(sweep=sweep, metric=metric, target=target, savings=found)


def latency_list(results: Sequence[LatencyResult]) -> LatencyList:
    return LatencyList(latencies=[_latency(result) for result in results])


def stage(summary: LatencySummary) -> StageLatency:
    return StageLatency.model_validate(summary.record())


def deadline(fps: int, missed: int, frames: int) -> Deadline:
    return Deadline(fps=fps, deadline_us=1_000_000 / fps, missed_frames=missed, missed_share=missed / frames)


def _point(result: PointResult) -> SweepPoint:
    point = result.point
    return SweepPoint(
        key=point.key,
        clip=point.clip,
        upscaler=point.upscaler,
        label=label(point.upscaler),
        width=point.width,
        height=point.height,
        fps=point.fps,
        low_height=point.low_height,
        rendered_small=point.low_sha256 is not None,
        requested_kbps=point.requested_kbps,
        bitrate_kbps=result.bitrate_kbps,
        flags=[flag.value for flag in result.flags],
        quality=Quality.model_validate(result.quality.record()),
        lpips=result.lpips,
        lpips_undefined=result.lpips_undefined,
        encoder=point.encoder,
        versions=point.versions,
    )


def _curve(series: Series, metric: MetricName) -> SweepCurve:
    points = [
        CurvePoint(bitrate_kbps=result.bitrate_kbps, requested_kbps=result.point.requested_kbps, quality=getattr(result.quality, metric))
        for result in series.results
    ]
    missing = series.curve(metric).missing
    return SweepCurve(upscaler=series.upscaler, label=series.label, low_height=series.low_height, points=points, undefined=missing)


def _bd_rate(clip: str, series: Series, anchor: Series) -> BdRate:
    comparison = compare(series, anchor)
    return BdRate(
        clip=clip,
        series=_name(series),
        anchor=_name(anchor),
        bd_rate_percent={metric: _figure(comparison.bd_rate_percent[metric]) for metric in get_args(MetricName)},
        bd_quality={metric: _figure(comparison.bd_quality[metric]) for metric in get_args(MetricName)},
    )


def _saving(clip: str, series: Series, of_clip: Sequence[Series], metric: str, target: float) -> Saving:
    against = {anchor.upscaler: anchor.curve(metric) for anchor in anchors(series, of_clip)}
    curve = series.curve(metric)
    over = {name: _figure(saving(anchor, curve, target)) for name, anchor in against.items()}
    return Saving(
        clip=clip,
        series=_name(series),
        bitrate_kbps=_figure(bitrate_at(curve, target)),
        over_native_percent=over.get(NO_UPSCALER),
        over_bicubic_percent=over.get(BASELINE),
    )


def _latency(result: LatencyResult) -> SweepLatency:
    return SweepLatency(
        clip=result.clip,
        upscaler=result.upscaler,
        label=label(result.upscaler),
        width=result.width,
        height=result.height,
        low_height=result.low_height,
        bitrate_kbps=result.bitrate_kbps,
        machine=result.machine,
        threads=result.threads,
        frames=result.frames,
        latency_us={name: stage(summary) for name, summary in result.latency_us.items()},
        deadlines=[deadline(fps, missed, result.frames) for fps, missed in result.deadline_misses.items()],
    )


def _name(series: Series) -> SeriesName:
    return SeriesName(upscaler=series.upscaler, label=series.label, low_height=series.low_height)


def _figure(number: Number) -> Figure:
    if isinstance(number, Undefined):
        return Figure(value=None, undefined=number.reason)
    return Figure(value=number, undefined=None)
