"""gamesr-sweep: rate-distortion curves of every upscaler on any clips, and what it costs in milliseconds."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing
from importlib.util import find_spec
from pathlib import Path

from client.command import command_parser, run_command, whole_number
from client.cores import physical_cores
from client.errors import GamesrError, OutputError, how_to_install
from client.whole_file import write_whole
from server.cluster import DaskWorkers
from server.events import (
    Event,
    LatencyDone,
    LatencyFailed,
    LatencyReused,
    PointDone,
    PointFailed,
    PointReused,
    SweepDone,
    event_record,
)
from server.export import points_csv, sweep_json
from server.names import shown
from server.plan import Plan, Request, make_plan
from server.points import LatencyResult, PointResult
from server.progress import SweepProgress
from server.store import Store
from server.summary import summary
from server.sweep import run_sweep
from server.workers import LocalWorkers, Workers

PROGRAM = "gamesr-sweep"
SWEEP_JSON = "sweep.json"
EXAMPLES = """\
examples:
  gamesr-sweep match_1080p.mp4 --out report
      half and a third of the height, the default bitrates and upscalers; report/ gets the results
  gamesr-sweep match_1080p.mkv --heights 540 --bitrates 2,4,8,16 --upscalers none,bicubic,gamesr,mine_x2.onnx --frames 120
      one height, two shipped models, one of yours and the native curve, over the first 120 frames
  gamesr-sweep match_1080p.mkv --render match_1080p.mkv match_540p.mkv
      at 540 lines the picture was rendered by the game and not downscaled

what is measured:
  The clip is downscaled by area (or taken from --render), encoded as a cloud-gaming server does (x264 zerolatency, veryfast,
  no B-frames, one reference, an IDR every second, a VBV of four frames), decoded, upscaled by the code that gamesr-upscale
  runs, and measured against the clip. The upscaler `none` is the clip itself, encoded at its full size. Points use the true
  bitrate, counted from packets. When all points are there, latency is measured on the stream of the middle bitrate, with
  nothing else of the sweep running.

Results are kept in the store: the same command goes on where it was stopped, also where something failed and its report says
so, and another one reuses what it shares.
Exit status: 0 done, 1 refused or something failed (one sentence says why; what was finished stays), 2 wrong usage,
130 interrupted.
"""


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Measure what upscaling on the client buys in bits, and what it costs in milliseconds.", EXAMPLES)
    parser.add_argument("clips", metavar="CLIP", nargs="+", type=Path, help="a video in full size, which everything is measured against")
    parser.add_argument(
        "--bitrates", metavar="MBPS,...", type=_megabits, default="2,4,6,8,13,20,25", help="megabits a second (default: %(default)s)"
    )
    parser.add_argument(
        "--heights", metavar="LINES,...", type=_counts, help="heights to encode at (default: half and a third of each clip's)"
    )
    parser.add_argument(
        "--upscalers",
        metavar="NAME|FILE,...",
        type=_names,
        default="none,bicubic,lanczos,fsr1,gamesr",
        help="shipped models or .onnx files; none is the clip itself at full size (default: %(default)s)",
    )
    parser.add_argument(
        "--render",
        metavar=("CLIP", "SMALL"),
        nargs=2,
        type=Path,
        action="append",
        default=[],
        help="SMALL shows the same frames as CLIP, rendered at half or a third of its size; repeatable",
    )
    parser.add_argument(
        "--fps", metavar="N", type=whole_number(), help="frames a second, a whole part of the clips' own rate (default: that rate)"
    )
    parser.add_argument("--frames", metavar="N", type=whole_number(), help="measure at most so many frames of each clip (default: all)")
    parser.add_argument(
        "--lpips",
        metavar="FILE",
        type=Path,
        help="an ONNX file of LPIPS: two RGB pictures in, float32 (1, 3, H, W) in -1..1, one number out",
    )
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=whole_number(),
        default=physical_cores(),
        help="worker processes (default: the physical cores, %(default)s)",
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="compute on the cluster of this Dask scheduler; latency is still measured here")
    parser.add_argument(
        "--store", metavar="FILE", type=Path, default=Path("gamesr-sweep.sqlite"), help="where results are kept (default: %(default)s)"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="write the report (HTML, Markdown, SVG, PNG), points.csv and sweep.json here"
    )
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")
    parser.add_argument("--json", action="store_true", help="print every event as one line of JSON instead of the summary")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)
    command = shown(shlex.join([PROGRAM, *(sys.argv[1:] if argv is None else argv)]))

    def work() -> None:
        failures = sweep(arguments, command)
        if failures:
            if arguments.debug:
                print(failures[0].trace, file=sys.stderr)
            raise GamesrError(f"{len(failures)} points or latencies could not be measured, the first one because {failures[0].reason}")

    kept = f"interrupted: what was finished is in {arguments.store}, and the same command goes on"
    return run_command(PROGRAM, work, debug=arguments.debug, interrupted=kept)


def sweep(arguments: argparse.Namespace, command: str) -> list[PointFailed | LatencyFailed]:
    """Everything between the arguments and what is printed and written; returns what failed. Raises GamesrError."""
    _prepare(arguments.out, command, arguments.force)
    request = Request(
        clips=arguments.clips,
        bitrates_kbps=arguments.bitrates,
        upscalers=arguments.upscalers,
        heights=arguments.heights,
        renders=[tuple(pair) for pair in arguments.render],
        fps=arguments.fps,
        frames=arguments.frames,
        lpips=arguments.lpips,
    )
    plan = make_plan(request)
    found = _Found(plan)
    with ExitStack() as stack:
        store = stack.enter_context(Store(arguments.store))
        workers: Workers = stack.enter_context(DaskWorkers(arguments.dask)) if arguments.dask else LocalWorkers(arguments.jobs)
        progress = stack.enter_context(SweepProgress(sys.stderr))
        for event in stack.enter_context(closing(run_sweep(plan, store, workers))):
            found.take(event)
            progress.show(event)
            if arguments.json:
                print(json.dumps(event_record(event), allow_nan=False), flush=True)
    if not arguments.json:
        print(summary(found.points, found.latencies, found.done), flush=True)
    if arguments.out and found.points:
        _write(arguments.out, found, command)
        if not arguments.json:
            print(f"the report, with savings and BD-rates: {shown(str(arguments.out / 'report.html'))}", flush=True)
    return found.failures


class _Found:
    """What the events brought, in the order of the plan."""

    def __init__(self, plan: Plan) -> None:
        self._order = {point.key: index for index, point in enumerate(plan.points)}
        self._points: list[PointResult] = []
        self.latencies: list[LatencyResult] = []
        self.failures: list[PointFailed | LatencyFailed] = []
        self.done = SweepDone(0, 0, 0, 0.0, 0.0)

    def take(self, event: Event) -> None:
        if isinstance(event, PointDone | PointReused):
            self._points.append(event.result)
        elif isinstance(event, LatencyDone | LatencyReused):
            self.latencies.append(event.result)
        elif isinstance(event, PointFailed | LatencyFailed):
            self.failures.append(event)
        elif isinstance(event, SweepDone):
            self.done = event

    @property
    def points(self) -> list[PointResult]:
        return sorted(self._points, key=lambda result: self._order[result.point.key])


def _prepare(out: Path | None, command: str, force: bool) -> None:
    """All is there that writing needs, before hours of work go into what is to be written: the folder too, which is empty, given up, or
    holds a report of the same command that is not whole.
    """
    if out is None:
        return
    missing = [name for name in ("bjontegaard", "matplotlib") if find_spec(name) is None]
    if missing:
        raise OutputError(f"the report of --out needs {' and '.join(missing)}: {how_to_install('sweep')}")
    there = next(folder for folder in (out.absolute(), *out.absolute().parents) if os.path.lexists(folder))
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise OutputError(f"cannot write into {out}: {there} is {'not writable' if there.is_dir() else 'no folder'}")
    if there == out.absolute() and any(out.iterdir()) and not (force or _unfinished(out, command)):
        raise OutputError(f"{out} is not empty: name another folder with --out, or replace what is in it with --force")


def _unfinished(out: Path, command: str) -> bool:
    """Whether the folder is this command's, and its report lacks what failed or was never written."""
    try:
        record = json.loads((out / SWEEP_JSON).read_bytes())
        return record["command"] == command and (bool(record["failures"]) or not (out / "report.html").exists())
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _write(out: Path, found: _Found, command: str) -> None:
    from server.report import write_report  # not above: every worker would load a drawing library

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write into {out}: {error.strerror}") from error
    # First, so that the same command knows the folder again.
    write_whole(out / SWEEP_JSON, sweep_json(found.points, found.latencies, found.failures, found.done, command=command))
    write_whole(out / "points.csv", points_csv(found.points))
    write_report(out, found.points, found.latencies, found.failures, command=command)


def _names(text: str) -> list[str]:
    return text.split(",")


def _counts(text: str) -> list[int]:
    return [whole_number()(part) for part in text.split(",")]


def _megabits(text: str) -> list[int]:
    """Megabits a second, as kilobits."""
    try:
        values = [round(float(part) * 1000) for part in text.split(",")]
    except (ValueError, OverflowError):
        values = [0]
    if not all(1 <= value <= 1_000_000 for value in values):
        raise argparse.ArgumentTypeError(f"{text} is not between 0.001 and 1000 megabits a second")
    return values
