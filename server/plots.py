"""Pictures of what was measured: rate-distortion curves, latency against the deadlines of 60 and 120 frames a second, PSNR over time."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import cycle, groupby, product
from statistics import fmean
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

from client.quality import psnr_db
from server.curves import GRADES, METRICS, Series, label, series_by_clip
from server.points import NO_UPSCALER, LatencyResult, PointResult
from server.viewing import View, Viewing

# M. Okabe and K. Ito, "Color Universal Design", 2008, without the yellow, which is too pale for a line on white.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
_MARKERS = ("s", "^", "D", "v", "P", "X")
_LINES = ("-", "--", ":")
_GREY, _DEADLINE = "#767676", "#D55E00"
_SMALL = 7.5  # points
_NAME_HEIGHT = 0.066  # of a panel's height
_MBPS_TICKS = (0.25, 0.5, 1, 2, 4, 8, 16, 32, 64)
_PANEL_INCHES = (4.8, 3.6)
_COLUMNS = 2
_DEADLINES_MS = {60: 1000 / 60, 120: 1000 / 120}
_SHADES = {View.DAMAGED: (_COLOURS[1], 0.25), View.FROZEN: (_GREY, 0.5)}
_LEAST_MS = 0.5  # where the axis of latencies begins


def rd_figures(results: Sequence[PointResult]) -> Iterator[tuple[str, Figure]]:
    """A figure for every metric and encoded height, with its name: one panel a clip that has it, with native resolution."""
    clips = series_by_clip(results)
    heights = {series.low_height: None for of_clip in clips.values() for series in of_clip if series.upscaler != NO_UPSCALER}
    styles = _styles([series.label for of_clip in clips.values() for series in of_clip])
    for metric, low_height in product(METRICS, heights):
        panels = {
            clip: [series for series in of_clip if series.upscaler == NO_UPSCALER or series.low_height == low_height]
            for clip, of_clip in clips.items()
            if any(series.upscaler != NO_UPSCALER and series.low_height == low_height for series in of_clip)
        }
        with _look():
            figure, axes = _panels(len(panels))
            for axis, (clip, of_clip) in zip(axes, panels.items(), strict=True):
                _draw_rd(axis, clip, of_clip, metric, styles)
        yield f"rd_{metric.removesuffix('_db')}_{low_height}p", figure


def latency_figure(latencies: Sequence[LatencyResult]) -> Figure:
    """Bars of p50 and p95 of a whole frame, decode to write, one panel a clip, with the two deadlines."""
    clips: dict[str, list[LatencyResult]] = {}
    for latency in latencies:
        clips.setdefault(latency.clip, []).append(latency)
    with _look():
        figure, axes = _panels(len(clips))
        for axis, (clip, of_clip) in zip(axes, clips.items(), strict=True):
            _draw_latency(axis, clip, of_clip)
    return figure


def over_time_figure(viewings: Mapping[str, Viewing]) -> Figure:
    """PSNR-Y of every picture that was sent, by upscaler, over time: one panel a title, damaged and frozen times shaded."""
    with _look():
        figure, axes = _panels(len(viewings))
        for axis, (title, seen) in zip(axes, viewings.items(), strict=True):
            _draw_over_time(axis, title, seen)
    return figure


def rendered(figure: Figure, kind: str) -> bytes:
    """The file's content as `svg` or `png`; the same figure always gives the same bytes."""
    target = io.BytesIO()
    with _look(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font", UserWarning)  # of a clip's name: a box says as much
        undated = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(target, format=kind, dpi=180, bbox_inches="tight", pad_inches=0.08, metadata=undated)
    return target.getvalue()


def _look() -> AbstractContextManager[None]:
    return mpl.rc_context(
        {
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.titlesize": 10,
            "axes.titlelocation": "left",
            "axes.titleweight": "bold",
            "text.parse_math": False,  # a clip's name may hold dollars
            "svg.hashsalt": "gamesr",  # the names of parts in an SVG are random without it
        }
    )


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    figure = Figure(figsize=(columns * _PANEL_INCHES[0], rows * _PANEL_INCHES[1]), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, number + 1) for number in range(count)]


def _styles(labels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """A colour, a marker and a line for every upscaler, by the order of their names' first appearance; native is black."""
    names = [name for name in dict.fromkeys(labels) if name != "native"]
    looks = cycle((line, *look) for line in _LINES for look in zip(_COLOURS, _MARKERS, strict=True))
    styles = {
        name: {"color": colour, "marker": marker, "linestyle": line} for name, (line, colour, marker) in zip(names, looks, strict=False)
    }
    return {"native": {"color": "black", "marker": "o", "linestyle": "-"}, **styles}


def _draw_rd(axis: Axes, clip: str, of_clip: Sequence[Series], metric: str, styles: dict[str, dict[str, Any]]) -> None:
    ends = []
    for series in of_clip:
        curve = series.curve(metric)
        if not curve.qualities:
            continue
        rates = [rate / 1000 for rate in curve.bitrates_kbps]
        style = styles[series.label]
        axis.plot(rates, curve.qualities, **style, linewidth=1.3, markersize=6, markeredgecolor="white", markeredgewidth=0.6, clip_on=False)
        ends.append((curve.qualities[-1], rates[-1], series.label, style["color"]))
    upscaled = [series.results[0].point for series in of_clip if series.upscaler != NO_UPSCALER]
    axis.set_title(f"{clip}, {upscaled[0].low_height}p to {upscaled[0].height}p" if upscaled else clip)
    axis.set_xscale("log")
    axis.set_xlabel("bitrate, Mbit/s")
    axis.set_ylabel(f"{METRICS[metric]}{', dB' if metric.endswith('_db') else ''}")
    axis.xaxis.set_major_locator(FixedLocator(_MBPS_TICKS))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    if metric.startswith("vmaf"):
        _draw_grades(axis)
    else:
        axis.grid(axis="y", color=_GREY, alpha=0.25, linewidth=0.6)
    _label_ends(axis, sorted(ends))


def _draw_grades(axis: Axes) -> None:
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, 65), max(min(high, 100), 93))
    for quality, word in GRADES.items():
        axis.axhline(quality, color=_GREY, linewidth=0.7, linestyle=(0, (4, 3)), zorder=0)
        axis.annotate(
            f"{word} {quality}",
            (0, quality),
            xycoords=axis.get_yaxis_transform(),
            xytext=(3, 2),
            textcoords="offset points",
            color=_GREY,
            fontsize=_SMALL,
        )


def _label_ends(axis: Axes, ends: list[tuple[float, float, str, str]]) -> None:
    """Each curve's name beside the panel, as near to its last point as the names below and above leave it room."""
    low, high = axis.get_ylim()
    step = _NAME_HEIGHT * (high - low)
    for (quality, rate, name, colour), place in zip(ends, _apart([end[0] for end in ends], step, high), strict=True):
        axis.annotate(
            name,
            (rate, quality),
            xytext=(1.05, (place - low) / (high - low)),
            textcoords="axes fraction",
            color=colour,
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6, "relpos": (0, 0.5), "shrinkA": 1, "shrinkB": 4},
        )


def _apart(wanted: Sequence[float], step: float, top: float) -> list[float]:
    """The places nearest to rising wanted ones, in the mean square, no two closer than `step` and none above `top`."""
    groups: list[list[float]] = []  # of neighbours that touch, each value with the room of those before it taken off
    for index, place in enumerate(wanted):
        groups.append([place - index * step])
        while len(groups) > 1 and fmean(groups[-1]) < fmean(groups[-2]):
            groups[-2:] = [groups[-2] + groups[-1]]
    highest = top - (len(wanted) - 1) * step
    return [min(fmean(group), highest) + index * step for index, group in enumerate(group for group in groups for _ in group)]


def _draw_latency(axis: Axes, clip: str, latencies: Sequence[LatencyResult]) -> None:
    names = [f"{label(item.upscaler)} {item.low_height}p" for item in latencies]
    totals = [item.latency_us["total"] for item in latencies]
    rows = range(len(latencies))
    p50, p95 = [total.p50 / 1000 for total in totals], [total.p95 / 1000 for total in totals]
    axis.barh(rows, p95, color=_COLOURS[5], height=0.62)
    axis.barh(rows, p50, color=_COLOURS[0], height=0.62)
    for fps, deadline in _DEADLINES_MS.items():
        axis.axvline(deadline, color=_DEADLINE, linewidth=1.1, linestyle=(0, (4, 2)))
        axis.annotate(
            f"{fps} fps",
            (deadline, 1),
            xycoords=axis.get_xaxis_transform(),
            xytext=(0, 2),
            textcoords="offset points",
            ha="left" if fps == min(_DEADLINES_MS) else "right",
            color=_DEADLINE,
            fontsize=_SMALL,
        )
    for row, (middle, high) in enumerate(zip(p50, p95, strict=True)):
        axis.annotate(
            f"{middle:.1f} / {high:.1f}",
            (high, row),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=_SMALL,
            bbox={"color": "white", "alpha": 0.85, "pad": 0.6},
        )
    axis.set_xscale("log")
    axis.set_xlim(_LEAST_MS, 8 * max([*p95, *_DEADLINES_MS.values()]))
    axis.set_yticks(rows, names)
    axis.invert_yaxis()
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_title(clip, pad=14)
    axis.set_xlabel("one frame, decode to write, ms: p50 (dark) / p95 (pale)")


def _draw_over_time(axis: Axes, title: str, seen: Viewing) -> None:
    for view, run in groupby(range(len(seen.views)), seen.views.__getitem__):
        if view in _SHADES:
            colour, alpha = _SHADES[view]
            indices = list(run)
            axis.axvspan(indices[0] / seen.fps, (indices[-1] + 1) / seen.fps, color=colour, alpha=alpha, linewidth=0)
    ends = []
    for name, style in _styles(list(seen.errors)).items():
        if name in seen.errors:
            times = [index / seen.fps for index in range(len(seen.views))]
            qualities = [psnr_db(error) if error else math.nan for error in seen.errors[name]]
            axis.plot(times, qualities, color=style["color"], linestyle=style["linestyle"], linewidth=1.1)
            ends.append((qualities[-1], times[-1], name, style["color"]))
    axis.set_title(title)
    axis.set_xlabel("time, s (orange: damaged, grey: frozen)")
    axis.set_ylabel("PSNR-Y of each picture, dB")
    axis.margins(x=0.01)
    axis.grid(axis="y", color=_GREY, alpha=0.25, linewidth=0.6)
    _label_ends(axis, sorted(end for end in ends if not math.isnan(end[0])))
