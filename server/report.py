"""A sweep's report: what upscaling buys in bits and what it costs in milliseconds, on one page that a paper can take from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from client.whole_file import write_whole
from server.curves import METRICS, Series, label, series_by_clip
from server.document import Block, Code, Heading, Picture, Table, Text, html_page, markdown
from server.events import LatencyFailed, PointFailed, failure_record
from server.latency import unmeasured
from server.plots import latency_figure, rd_figures, rendered
from server.points import LatencyResult, PointResult
from server.tables import Notes, bd_table, latency_table, points_table, saving_table

TITLE = "What upscaling on the client buys, and what it costs"
_FSR1 = ("fsr1", "easu")


def write_report(
    folder: Path,
    points: Sequence[PointResult],
    latencies: Sequence[LatencyResult],
    failures: Sequence[PointFailed | LatencyFailed],
    *,
    command: str,
) -> list[Path]:
    """Write report.md, report.html and the figures, each as SVG and PNG, into a folder that is there.

    There is at least one point. Files of these names are replaced; each of them appears whole or not at all, the pages last.
    Returns what was written. Raises OutputError.
    """
    figures = dict(rd_figures(points))
    if latencies:
        figures["latency"] = latency_figure(latencies)
    svg = {name: rendered(figure, "svg") for name, figure in figures.items()}
    pictures = [Picture(name, _description(name), content) for name, content in svg.items()]
    blocks = [Heading(1, TITLE), Code(command), *_missing(failures), *_page(points, latencies, pictures)]
    files: dict[str, str | bytes] = {f"{name}.svg": content for name, content in svg.items()}
    files |= {f"{name}.png": rendered(figure, "png") for name, figure in figures.items()}
    files |= {"report.md": markdown(blocks), "report.html": html_page(TITLE, blocks)}
    for name, content in files.items():
        write_whole(folder / name, content)
    return [folder / name for name in files]


def _description(figure: str) -> str:
    if figure == "latency":
        return "Latency of a whole frame, p50 and p95, against the deadlines of 60 and 120 frames a second"
    metric, height = figure.removeprefix("rd_").rsplit("_", 1)
    titles = {name.removesuffix("_db"): title for name, title in METRICS.items()}
    return f"{titles[metric]} over bitrate, {height} upscaled and native resolution, one panel a clip"


def _missing(failures: Sequence[PointFailed | LatencyFailed]) -> list[Block]:
    """Said before any figure: a curve with fewer points looks like any other."""
    if not failures:
        return []
    points = sum(isinstance(failed, PointFailed) for failed in failures)
    rows = []
    for record in map(failure_record, failures):
        asked = "latency" if record["requested_kbps"] is None else str(record["requested_kbps"])
        rows.append([record["clip"], f"{label(record['upscaler'])} {record['low_height']}p", asked, record["reason"]])
    return [
        Heading(2, "What is missing"),
        Text(
            f"{points} points and {len(failures) - points} latencies could not be measured: the curves, BD-rates and savings below are "
            "of the points that are there. The same command tries again what is missing."
        ),
        Table(["clip", "upscaler", "asked kbps", "why"], rows),
    ]


def _page(points: Sequence[PointResult], latencies: Sequence[LatencyResult], pictures: Sequence[Picture]) -> list[Block]:
    blocks: list[Block] = [*_setting(points, latencies), Heading(2, "Curves"), *pictures]
    for clip, of_clip in series_by_clip(points).items():
        blocks += _clip(clip, of_clip, [latency for latency in latencies if latency.clip == clip])
    return blocks


def _setting(points: Sequence[PointResult], latencies: Sequence[LatencyResult]) -> list[Block]:
    """What a reader has to know before any figure."""
    first = points[0].point
    bitrates = ", ".join(str(kbps) for kbps in sorted({result.point.requested_kbps for result in points}))
    fixed = {name: value for name, value in first.encoder.items() if all(result.point.encoder.get(name) == value for result in points)}
    versions = {f"{name} {version}" for result in points for name, version in result.point.versions.items()}
    return [
        Heading(2, "How it was measured"),
        _clips_table(points),
        Text(
            "Every clip was downscaled by area, encoded, decoded, upscaled to its size and measured against itself; native is the clip "
            f"encoded at its full size. {_renders(points)}Bitrates are true ones, counted from packets."
        ),
        Text(
            f"Encoder: {', '.join(f'{name} {value}' for name, value in fixed.items())}; asked for {bitrates} kbps. "
            f"What x264 was told for {first.requested_kbps} kbps:"
        ),
        Code(str(first.encoder.get("x264_params", ""))),
        Text(f"Versions: {'; '.join(sorted(versions))}."),
        Text(_lpips(points)),
        *(Text(text) for text in _latency_setting(latencies, unmeasured(first.frames))),
        Text(
            "BD-rate is the percentage of bits that an upscaler takes more (+) or fewer (-) at equal quality; BD-VMAF and BD-PSNR are "
            "what it gains at equal bits: means over what both curves reach, in log bitrate, interpolated by PCHIP. No curve is "
            "extrapolated. Sharpening buys VMAF; it does not buy VMAF-NEG. VMAF 70, 80 and 90 are taken for fair, good and excellent."
        ),
    ]


def _clips_table(points: Sequence[PointResult]) -> Table:
    clips = {(r.point.clip, r.point.width, r.point.height, r.point.fps, r.quality.frames, r.point.clip_sha256): None for r in points}
    rows = [[clip, f"{width}x{height}", str(fps), str(frames), sha256[:12]] for clip, width, height, fps, frames, sha256 in clips]
    return Table(["clip", "size", "frames a second", "frames measured", "sha256"], rows)


def _renders(points: Sequence[PointResult]) -> str:
    rendered_small = {f"{r.point.clip} at {r.point.low_height} lines" for r in points if r.point.low_sha256 is not None}
    return f"Rendered small by the game, not downscaled: {', '.join(sorted(rendered_small))}. " if rendered_small else ""


def _lpips(points: Sequence[PointResult]) -> str:
    reasons = {result.lpips_undefined for result in points if result.lpips_undefined is not None}
    if all(result.lpips is None for result in points):
        return f"LPIPS was not measured: {'; '.join(sorted(reasons))}."
    return "LPIPS, 0 is best, stands beside every point that it was measured of."


def _latency_setting(latencies: Sequence[LatencyResult], reason: str | None) -> list[str]:
    if not latencies:
        return [f"Latency was not measured{f': {reason}' if reason else ''}."]
    machines = {f"{latency.threads} threads of {latency.machine}" for latency in latencies}
    texts = [
        f"Latency: {'; '.join(sorted(machines))}; taken in a pass of its own while nothing else of the sweep ran, warm-up not counted. "
        "A frame is its decode, its upscaling and its handing over; a deadline is missed by a frame that took longer than one frame lasts."
    ]
    if any(latency.upscaler in _FSR1 for latency in latencies):
        texts.append(
            "FSR 1 and EASU are made for the shaders of a GPU: their time on this CPU is not their time on a GPU. AMD means them for "
            "up to x2 in each direction."
        )
    return texts


def _clip(clip: str, of_clip: Sequence[Series], latencies: Sequence[LatencyResult]) -> list[Block]:
    notes = Notes()
    blocks: list[Block] = [Heading(2, clip), bd_table(of_clip, notes), saving_table(of_clip, notes)]
    if latencies:
        blocks.append(latency_table(latencies))
    blocks.append(points_table(of_clip, notes))
    return [*blocks, *(Text(text) for text in notes.texts())]
