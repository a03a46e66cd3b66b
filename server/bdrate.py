"""What one rate-quality curve saves over another: BD-rate, BD-quality, and the bitrate at a quality. A number or a reason, nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import bjontegaard

LEAST_POINTS = 4
_METHOD = "pchip"  # as in the JCT-VC and JVET spreadsheets: a third-order polynomial through all points can swing between them


@dataclass(frozen=True)
class Undefined:
    """Why there is no number, in words."""

    reason: str


Figure = float | Undefined


@dataclass(frozen=True)
class Curve:
    """Quality over true bitrate, by rising bitrate; `name` and `metric` are what the reasons call it and its quality.

    `missing` says why a point of it has no quality; nothing is then computed from the others.
    """

    name: str
    metric: str
    bitrates_kbps: tuple[float, ...]
    qualities: tuple[float, ...]
    missing: str | None = None

    @classmethod
    def through(cls, name: str, metric: str, points: Iterable[tuple[float, float]], missing: str | None = None) -> Curve:
        """A curve of (bitrate, quality) points in any order."""
        ordered = sorted(points)
        return cls(name, metric, tuple(rate for rate, _ in ordered), tuple(quality for _, quality in ordered), missing)


def bd_rate(anchor: Curve, test: Curve) -> Figure:
    """Percent of bits that `test` needs more than `anchor` for the same quality (negative: fewer).

    The mean of the difference in log bitrate over the qualities that both reach. G. Bjontegaard, "Calculation of average
    PSNR differences between RD-curves", ITU-T VCEG-M33, 2001; interpolated piecewise, as in JCTVC-L1100.
    """
    if found := _incomparable(anchor, test):
        return found
    low, high = shared(anchor.qualities, test.qualities)
    if low >= high:
        ranges = (f"{c.name} has {c.metric} {c.qualities[0]:.1f} to {c.qualities[-1]:.1f}" for c in (anchor, test))
        return Undefined(f"no overlap: {', '.join(ranges)}")
    return _delta(bjontegaard.bd_rate, anchor, test)


def bd_quality(anchor: Curve, test: Curve) -> Figure:
    """By how much the quality of `test` is above that of `anchor` at the same bitrate: BD-PSNR in dB, BD-VMAF in points.

    The mean over the log bitrates that both have; source as for `bd_rate`.
    """
    if found := _incomparable(anchor, test):
        return found
    low, high = shared(anchor.bitrates_kbps, test.bitrates_kbps)
    if low >= high:
        ranges = (f"{c.name} has {c.bitrates_kbps[0]:.0f} to {c.bitrates_kbps[-1]:.0f} kbps" for c in (anchor, test))
        return Undefined(f"no overlap: {', '.join(ranges)}")
    return _delta(bjontegaard.bd_psnr, anchor, test)


def bitrate_at(curve: Curve, quality: float) -> Figure:
    """The bitrate in kbps at which the curve reaches a quality, interpolated as BD-rate interpolates, never extrapolated."""
    if found := _malformed(curve):
        return found
    first, last = curve.qualities[0], curve.qualities[-1]
    if quality < first:
        return Undefined(f"{curve.name} is above {curve.metric} {quality:g} from its lowest bitrate on ({first:.1f} at {_kbps(curve, 0)})")
    if quality > last:
        return Undefined(f"{curve.name} never reaches {curve.metric} {quality:g} ({last:.1f} at {_kbps(curve, -1)})")
    data = curve.bitrates_kbps, curve.qualities
    _, log10_rate, _ = bjontegaard.bd_rate(*data, *data, method=_METHOD, interpolators=True)
    return float(10 ** log10_rate(quality))


def saving(anchor: Curve, test: Curve, quality: float) -> Figure:
    """Percent of the bits of `anchor` at a quality that `test` saves (negative: it takes more); one reason where both have one."""
    after, before = bitrate_at(test, quality), bitrate_at(anchor, quality)
    if isinstance(after, Undefined):
        return after
    if isinstance(before, Undefined):
        return before
    return 100 * (1 - after / before)


def shared(anchor: tuple[float, ...], test: tuple[float, ...]) -> tuple[float, float]:
    """The range that two rising sequences share; its end is not above its beginning where they share none."""
    return max(anchor[0], test[0]), min(anchor[-1], test[-1])


def _delta(measure: Any, anchor: Curve, test: Curve) -> float:
    data = anchor.bitrates_kbps, anchor.qualities, test.bitrates_kbps, test.qualities
    return float(measure(*data, method=_METHOD, require_matching_points=False, min_overlap=0))


def _incomparable(anchor: Curve, test: Curve) -> Undefined | None:
    return _malformed(anchor) or _malformed(test)


def _malformed(curve: Curve) -> Undefined | None:
    """Why nothing can be interpolated on this curve."""
    if curve.missing is not None:
        return Undefined(f"{curve.name} has no {curve.metric}: {curve.missing}")
    if len(curve.qualities) < LEAST_POINTS:
        return Undefined(f"{curve.name} has {len(curve.qualities)} points, fewer than {LEAST_POINTS}")
    for index in range(1, len(curve.qualities)):
        step = f"from {_kbps(curve, index - 1)} to {_kbps(curve, index)}"
        if curve.bitrates_kbps[index] == curve.bitrates_kbps[index - 1]:
            return Undefined(f"{curve.name} is saturated: two of its points have {_kbps(curve, index)}")
        if curve.qualities[index] == curve.qualities[index - 1]:
            return Undefined(f"{curve.name} is saturated: {curve.metric} stays at {curve.qualities[index]:.1f} {step}")
        if curve.qualities[index] < curve.qualities[index - 1]:
            before, after = curve.qualities[index - 1 : index + 1]
            return Undefined(f"{curve.name} is not monotone: {curve.metric} falls {step} ({before:.3f}, {after:.3f})")
    return None


def _kbps(curve: Curve, index: int) -> str:
    return f"{curve.bitrates_kbps[index]:.0f} kbps"
