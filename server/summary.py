"""What a sweep says at its end, for people: a line a point, a line a latency, and what the harness took."""

from __future__ import annotations

from collections.abc import Sequence

from server.events import SweepDone
from server.latency import unmeasured
from server.points import DEADLINES_FPS, LatencyResult, PointResult

_FIGURES = {
    "PSNR-Y dB": ("psnr_y_db", ".2f"),
    "SSIM-Y": ("ssim_y", ".4f"),
    "VMAF": ("vmaf", ".2f"),
    "VMAF-NEG": ("vmaf_neg", ".2f"),
    "temporal": ("temporal_error", ".2f"),
}


def summary(results: Sequence[PointResult], latencies: Sequence[LatencyResult], done: SweepDone) -> str:
    """Plain text of a width that fits a terminal; figures that are not defined are a dash, with their reasons below."""
    names = max((len(result.point.upscaler) for result in results), default=0)
    lines: list[str] = []
    for clip in dict.fromkeys(result.point.clip for result in results):
        mine = [result for result in results if result.point.clip == clip]
        lines += [clip, f"  {'upscaler':<{names}}{'height':>8}{'asked':>8}{'kbps':>9}" + "".join(f"{head:>11}" for head in _FIGURES)]
        lines += [_point_line(result, names) for result in mine]
        mine_latencies = [latency for latency in latencies if latency.clip == clip]
        if mine_latencies:
            misses = "".join(f"{f'> 1/{fps} s':>11}" for fps in DEADLINES_FPS)
            heads = "".join(f"{head:>9}" for head in ("p50 ms", "p95 ms", "p99 ms"))
            lines += [
                f"  latency, while nothing else of the sweep ran, on {mine_latencies[0].threads} threads of {mine_latencies[0].machine}"
            ]
            lines += [f"  {'upscaler':<{names}}{'height':>8}{heads}{misses}{'frames':>9}"]
            lines += [_latency_line(latency, names) for latency in mine_latencies]
    lines += [f"note: no {reason}" for reason in _reasons(results)]
    lines.append(f"{done.done} points measured, {done.reused} reused, {done.failed} failed")
    if done.overhead is not None:
        lines.append(f"harness overhead {100 * done.overhead:.1f}% over {done.work_s:.0f} s of encodes, decodes, inferences and metrics")
    return "\n".join(lines)


def _point_line(result: PointResult, names: int) -> str:
    point, figures = result.point, result.quality.record()
    cells = ("-" if figures[name] is None else format(figures[name], form) for name, form in _FIGURES.values())
    line = f"  {point.upscaler:<{names}}{point.low_height:>8}{point.requested_kbps:>8}{result.bitrate_kbps:>9.0f}"
    return line + "".join(f"{cell:>11}" for cell in cells) + "".join(f"  {flag.value}" for flag in result.flags)


def _latency_line(latency: LatencyResult, names: int) -> str:
    total = latency.latency_us["total"]
    times = "".join(f"{value / 1000:>9.2f}" for value in (total.p50, total.p95, total.p99))
    misses = "".join(f"{latency.deadline_misses[fps]:>11}" for fps in DEADLINES_FPS)
    return f"  {latency.upscaler:<{names}}{latency.low_height:>8}{times}{misses}{latency.frames:>9}"


def _reasons(results: Sequence[PointResult]) -> list[str]:
    """Why figures are missing, each reason once."""
    heads = {name: head for head, (name, _) in _FIGURES.items()}
    found = [(heads[name], reason) for result in results for name, reason in result.quality.undefined.items() if name in heads]
    found += [("LPIPS", result.lpips_undefined) for result in results if result.lpips_undefined is not None]
    found += [("latency", reason) for result in results if (reason := unmeasured(result.point.frames)) is not None]
    return [f"{head}: {reason}" for head, reason in dict.fromkeys(found)]
