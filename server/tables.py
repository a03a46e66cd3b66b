"""The tables of a report, for one clip: BD figures, bits saved, latency, points. A cell without a number refers to its reason."""

from __future__ import annotations

from collections.abc import Sequence

from server.bdrate import Figure, Undefined, bitrate_at, shared
from server.curves import BASELINE, GRADES, METRICS, Comparison, Series, anchors, compare, label
from server.document import Table
from server.points import DEADLINES_FPS, NO_UPSCALER, LatencyResult

_NOTHING = "-"
_POINT_FIGURES = (
    ("PSNR-Y", "psnr_y_db", "{:.2f}"),
    ("U", "psnr_u_db", "{:.2f}"),
    ("V", "psnr_v_db", "{:.2f}"),
    ("SSIM-Y", "ssim_y", "{:.4f}"),
    ("VMAF", "vmaf", "{:.1f}"),
    ("harmonic", "vmaf_harmonic_mean", "{:.1f}"),
    ("5%", "vmaf_p5", "{:.1f}"),
    ("VMAF-NEG", "vmaf_neg", "{:.1f}"),
    ("harmonic", "vmaf_neg_harmonic_mean", "{:.1f}"),
    ("5%", "vmaf_neg_p5", "{:.1f}"),
    ("temporal error", "temporal_error", "{:.2f}"),
)


class Notes:
    """Reasons, each of them once, with the numbers by which cells refer to them."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}

    def cell(self, figure: Figure, form: str) -> str:
        """The figure in a form of str.format, or the number of its reason."""
        return self.refer(figure.reason) if isinstance(figure, Undefined) else form.format(figure)

    def refer(self, reason: str) -> str:
        return f"({self._numbers.setdefault(reason, len(self._numbers) + 1)})"

    def texts(self) -> list[str]:
        return [f"({number}) {reason}" for reason, number in self._numbers.items()]


def bd_table(of_clip: Sequence[Series], notes: Notes) -> Table:
    """A line for every upscaler and what it is held against; percent of bits, then quality at equal bits."""
    heads = ["upscaler", "against", *(f"BD-rate {head}" for head in METRICS.values()), *(f"BD-{head}" for head in METRICS.values())]
    return Table(
        [*heads, "over VMAF"], [_bd_row(compare(series, other), notes) for series in of_clip for other in anchors(series, of_clip)]
    )


def _bd_row(comparison: Comparison, notes: Notes) -> list[str]:
    rates = [notes.cell(figure, "{:+.1f}%") for figure in comparison.bd_rate_percent.values()]
    qualities = [notes.cell(figure, "{:+.2f}") for figure in comparison.bd_quality.values()]
    if isinstance(comparison.bd_rate_percent["vmaf"], Undefined):
        extent = _NOTHING
    else:
        low, high = shared(comparison.anchor.curve("vmaf").qualities, comparison.series.curve("vmaf").qualities)
        extent = f"{low:.0f} to {high:.0f}"
    return [comparison.series.name, comparison.anchor.name, *rates, *qualities, extent]


def saving_table(of_clip: Sequence[Series], notes: Notes) -> Table:
    """For every grade of VMAF the bitrate that reaches it, and the percentage saved against native and against bicubic."""
    heads = [head for grade, word in GRADES.items() for head in (f"VMAF {grade} ({word}), kbps", "saved over native", f"over {BASELINE}")]
    return Table(["upscaler", *heads], [[series.name, *_saving_cells(series, of_clip, notes)] for series in of_clip])


def _saving_cells(series: Series, of_clip: Sequence[Series], notes: Notes) -> list[str]:
    against = {anchor.upscaler: compare(series, anchor) for anchor in anchors(series, of_clip)}
    cells = []
    for grade in GRADES:
        cells.append(notes.cell(bitrate_at(series.curve("vmaf"), grade), "{:.0f}"))
        for name in (NO_UPSCALER, BASELINE):
            figure = against[name].saving_percent[grade] if name in against else None
            cells.append(_NOTHING if figure is None else notes.cell(figure, "{:.1f}%"))
    return cells


def latency_table(latencies: Sequence[LatencyResult]) -> Table:
    """Milliseconds a stage, p50 and p95, and of a whole frame; how many frames missed each deadline."""
    misses = [f"missed {fps} fps" for fps in DEADLINES_FPS]
    heads = ["upscaler", "kbps", "decode p50", "p95", "upscale p50", "p95", "frame p50", "p95", "p99", "max", *misses, "frames"]
    return Table(heads, [_latency_row(latency) for latency in latencies])


def _latency_row(latency: LatencyResult) -> list[str]:
    cells = [f"{label(latency.upscaler)} {latency.low_height}p", f"{latency.bitrate_kbps:.0f}"]
    for stage in ("decode", "upscale"):
        summary = latency.latency_us.get(stage)
        cells += [_NOTHING] * 2 if summary is None else [f"{us / 1000:.2f}" for us in (summary.p50, summary.p95)]
    total = latency.latency_us["total"]
    cells += [f"{us / 1000:.2f}" for us in (total.p50, total.p95, total.p99, total.max)]
    return [*cells, *(str(latency.deadline_misses[fps]) for fps in DEADLINES_FPS), str(latency.frames)]


def points_table(of_clip: Sequence[Series], notes: Notes) -> Table:
    """Every point: what was asked of the encoder, what came, and how good it was."""
    results = [(series.name, result) for series in of_clip for result in series.results]
    measured = any(result.lpips is not None for _, result in results)
    heads = ["upscaler", "asked kbps", "kbps", *(head for head, _, _ in _POINT_FIGURES), *(["LPIPS"] if measured else [])]
    rows = []
    for name, result in results:
        quality = result.quality
        flags = "".join(notes.refer(flag.value) for flag in result.flags)
        cells = [name, str(result.point.requested_kbps), f"{result.bitrate_kbps:.0f}{flags}"]
        for _, field, form in _POINT_FIGURES:
            reason = quality.undefined.get(field)
            cells.append(form.format(getattr(quality, field)) if reason is None else notes.refer(reason))
        if measured:
            cells.append(notes.refer(str(result.lpips_undefined)) if result.lpips is None else f"{result.lpips:.4f}")
        rows.append(cells)
    return Table(heads, rows, title=f"All {len(rows)} points")
