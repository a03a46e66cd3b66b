"""gamesr-frontier: milliseconds a frame against decibels over bicubic, of models on runtimes, all measured side by side."""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from statistics import fmean, median

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter
from tqdm import tqdm

from client.command import command_parser, run_command, whole_number
from client.errors import InputError, OutputError
from client.measurement import WARM_UP_FRAMES, Task, measure_in_fresh_process
from client.models import find_model
from client.runtime import PROVIDERS
from client.synthetic import write_synthetic_clip
from client.whole_file import write_whole
from model.evaluate import Row, evaluate, left_out
from model.footage import Degradation, FootageCache, Scene, load_scenes

PROGRAM = "gamesr-frontier"
EPILOG = """\
example:
  gamesr-frontier footage.toml --models bicubic lanczos live gamesr --providers cpu openvino-bfloat16 --svg frontier.svg

how it is measured:
  Quality is that of gamesr-evaluate, on the test scenes, by every runtime itself; rows are kept. Time is that of gamesr-bench:
  upscaling one frame of a made clip, 960x540 by 2 or 640x360 by 3, every run in a fresh process, models and runtimes in turn in
  every round, p50 and p95 as medians over the rounds. Over bicubic: dB of PSNR-Y above bicubic on the cpu runtime, one zero for
  all runtimes, mean over a game's scenes; bicubic on another runtime is a row like any other. Worst plane: the least that any of
  Y, U and V gains or loses over that bicubic in any game. A model on a runtime is on the frontier of an input when nothing that is
  as fast (p95) gains more PSNR-Y, games counted alike.

Exit status: 0 done, 1 refused or failed (one sentence says why), 2 wrong usage, 130 interrupted.
"""
YARDSTICK, YARDSTICK_PROVIDER = "bicubic", "cpu"  # one zero: a precision that cost bicubic too would else go unseen
FEWEST_TIMED_FRAMES = 20  # of fewer, the nearest rank of the 95th percentile is the slowest
PLANES = ("psnr_y_db", "psnr_u_db", "psnr_v_db")


@dataclass(frozen=True)
class Gains:
    """What a model on a runtime gains over bicubic on cpu on one input; `psnr_y_db` by game. VMAF-NEG is a mean, no difference."""

    psnr_y_db: dict[str, float]
    worst_plane_db: float
    vmaf_neg: float | None
    on_frontier: bool = False

    @property
    def mean_db(self) -> float:
        return fmean(self.psnr_y_db.values())


@dataclass
class Candidate:
    """A model on a runtime: milliseconds of upscaling one frame, and gains by input."""

    model: str
    provider: str
    parameters: int | None
    macs_540p: int | None
    p50_ms: float
    p95_ms: float
    gains: dict[str, Gains]


def gains_over_bicubic(rows: Sequence[Row]) -> dict[str, dict[tuple[str, str], Gains]]:
    """By input, then by (runtime, model), from rows of any runtimes that hold bicubic on cpu too; raises InputError for no PSNR."""
    groups: dict[tuple[str, str, str, str], list[Row]] = {}
    for row in rows:
        title, degradation = row["clip"].split()
        groups.setdefault((degradation, row["provider"], row["model"], title.split("/")[0]), []).append(row)
        if None in [row[plane] for plane in PLANES]:
            raise InputError(f"{row['model']} gives a plane of {title} exactly, which has no PSNR: leave that scene out")
    gains: dict[str, dict[tuple[str, str], Gains]] = {}
    for degradation, provider, model in dict.fromkeys(key[:3] for key in groups):
        over: dict[str, list[float]] = {}
        vmaf_neg: list[float | None] = []
        for (*_, game), own in [(key, group) for key, group in groups.items() if key[:3] == (degradation, provider, model)]:
            base = groups[degradation, YARDSTICK_PROVIDER, YARDSTICK, game]
            over[game] = [fmean(row[plane] for row in own) - fmean(row[plane] for row in base) for plane in PLANES]
            vmaf_neg += [row["vmaf_neg"] for row in own]
        known = [value for value in vmaf_neg if value is not None]
        gains.setdefault(degradation, {})[provider, model] = Gains(
            {game: planes[0] for game, planes in over.items()},
            min(min(planes) for planes in over.values()),
            fmean(known) if len(known) == len(vmaf_neg) else None,
        )
    return gains


def frontier(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which points (cost, gain) no other beats: none is as cheap or cheaper and gains more, or cheaper and gains as much."""
    return [not any((c <= cost and g > gain) or (c < cost and g >= gain) for c, g in points) for cost, gain in points]


def table(candidates: Sequence[Candidate], degradation: str) -> str:
    """Markdown for one input, fastest first; what is on the frontier is bold."""
    games = list(candidates[0].gains[degradation].psnr_y_db)
    heads = ["model", "runtime", "parameters", "GMAC, 540p", "ms p50", "p95", *games, "worst plane", "VMAF-NEG"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for candidate in sorted(candidates, key=lambda c: c.p95_ms):
        gains = candidate.gains[degradation]
        cells = [
            f"**{candidate.model}**" if gains.on_frontier else candidate.model,
            candidate.provider,
            "" if candidate.parameters is None else f"{candidate.parameters:,}",
            "" if candidate.macs_540p is None else f"{candidate.macs_540p / 1e9:.1f}",
            f"{candidate.p50_ms:.1f}",
            f"{candidate.p95_ms:.1f}",
            *(f"{gains.psnr_y_db[game]:+.2f}" for game in games),
            f"{gains.worst_plane_db:+.2f}",
            "undefined" if gains.vmaf_neg is None else f"{gains.vmaf_neg:.1f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def drawing(candidates: Sequence[Candidate]) -> bytes:
    """SVG: a panel an input, p95 against the mean gain, the frontier as a line, one frame of 60 fps as another; repeatable.

    A marker a runtime; a model's runtimes are joined, and the fastest bears its name, slanted, for tiers lie close together.
    """
    markers = dict(zip(dict.fromkeys(c.provider for c in candidates), "so^DvP", strict=False))
    inputs = list(candidates[0].gains)
    with mpl.rc_context(
        {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "gamesr", "svg.fonttype": "none"}
    ):
        figure = Figure(figsize=(5.2 * len(inputs), 4.2), layout="constrained")
        for number, degradation in enumerate(inputs):
            axis = figure.add_subplot(1, len(inputs), number + 1)
            points = sorted((c.p95_ms, c.gains[degradation].mean_db, c) for c in candidates)
            best = [(ms, db) for ms, db, c in points if c.gains[degradation].on_frontier]
            axis.step(*zip(*best, strict=True), where="post", color="#0072B2", linewidth=1.2)
            for ms, db, candidate in points:
                on = candidate.gains[degradation].on_frontier
                axis.plot(ms, db, markers[candidate.provider], color="#0072B2" if on else "#767676", markersize=5)
            for model in dict.fromkeys(candidate.model for _, _, candidate in points):
                own = [(ms, db) for ms, db, candidate in points if candidate.model == model]
                axis.plot(*zip(*own, strict=True), color="#767676", linewidth=0.5, zorder=0)
                axis.annotate(
                    model, own[0], xytext=(2, -4), textcoords="offset points", fontsize=7, rotation=-40, va="top", rotation_mode="anchor"
                )
            shapes = [Line2D([], [], color="#767676", marker=marker, linestyle="", label=name) for name, marker in markers.items()]
            axis.legend(handles=shapes, loc="lower right", frameon=False, fontsize=7)
            axis.axvline(1000 / 60, color="#D55E00", linewidth=1, linestyle=(0, (4, 2)))
            axis.axhline(0, color="#767676", linewidth=0.6)
            axis.set_xscale("log")
            axis.margins(x=0.18, y=0.16)
            axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.set_title(f"input {degradation}", loc="left", fontweight="bold", fontsize=10)
            axis.set_xlabel("upscaling one frame, p95 ms (dashed: one frame of 60 fps)")
            axis.set_ylabel("PSNR-Y over bicubic, dB, mean over games")
        target = io.BytesIO()
        figure.savefig(target, format="svg", metadata={"Date": None})
    return target.getvalue()


def measure(arguments: argparse.Namespace) -> list[Candidate]:
    """Every model on every runtime; raises GamesrError."""
    names = list(dict.fromkeys([YARDSTICK, *arguments.models]))
    scenes = load_scenes(arguments.footage, split="test")
    degradations = [Degradation.parse(text) for text in arguments.degradations]
    rows: list[Row] = []
    for provider in dict.fromkeys([YARDSTICK_PROVIDER, *arguments.providers]):
        models = names if provider in arguments.providers else [YARDSTICK]
        rows += tqdm(_rows(scenes, degradations, models, provider, arguments), desc=provider, unit="row", disable=not sys.stderr.isatty())
    if not rows:
        raise InputError(f"no scene of {arguments.footage} was rendered for {' or '.join(arguments.degradations)}")
    for sentence in left_out(rows, scenes, degradations, arguments.frames):
        print(f"{PROGRAM}: {sentence}", file=sys.stderr)
    gains = gains_over_bicubic(rows)
    candidates = []
    for (provider, model), (p50_ms, p95_ms) in _latencies(names, arguments).items():
        row = next(row for row in rows if (row["provider"], row["model"]) == (provider, model))
        of_model = {degradation: by_model[provider, model] for degradation, by_model in gains.items()}
        candidates.append(Candidate(model, provider, row["parameters"], row["macs_540p"], p50_ms, p95_ms, of_model))
    for degradation in candidates[0].gains:
        best = frontier([(c.p95_ms, c.gains[degradation].mean_db) for c in candidates])
        for candidate, on_frontier in zip(candidates, best, strict=True):
            candidate.gains[degradation] = replace(candidate.gains[degradation], on_frontier=on_frontier)
    return candidates


def _latencies(names: Sequence[str], arguments: argparse.Namespace) -> dict[tuple[str, str], tuple[float, float]]:
    """p50 and p95 of upscaling in ms by (runtime, model's own name), medians over rounds in which all take turns."""
    size = (960, 540) if arguments.scale == 2 else (640, 360)
    runs: dict[tuple[str, str], list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory(prefix="gamesr-frontier-") as folder:
        clip = Path(folder) / "clip.h264"
        write_synthetic_clip(clip, *size, WARM_UP_FRAMES + arguments.timed_frames)
        turns = list(product(range(arguments.rounds), names, arguments.providers))
        for _, name, provider in tqdm(turns, desc="timing", unit="run", disable=not sys.stderr.isatty()):
            run = measure_in_fresh_process(
                Task(find_model(name, arguments.scale), clip, arguments.timed_frames, provider, arguments.threads)
            )
            latency = run.latency_us["upscale"]
            runs.setdefault((provider, run.spec.name), []).append((latency.p50 / 1000, latency.p95 / 1000))
    return {key: (median(p50 for p50, _ in of), median(p95 for _, p95 in of)) for key, of in runs.items()}


def _rows(
    scenes: Sequence[Scene], degradations: Sequence[Degradation], names: Sequence[str], provider: str, arguments: argparse.Namespace
) -> Iterator[Row]:
    arguments.rows.parent.mkdir(parents=True, exist_ok=True)
    return evaluate(
        scenes,
        FootageCache(arguments.cache, arguments.frames),
        models=names,
        scales=[arguments.scale],
        degradations=degradations,
        provider=provider,
        threads=arguments.threads,
        store=arguments.rows,
    )


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Milliseconds against decibels: which models on which runtimes no other beats.", EPILOG)
    parser.add_argument("footage", type=Path, help="the footage list, a TOML file; its test scenes are used")
    parser.add_argument("--models", nargs="+", default=["lanczos", "live", "gamesr"], metavar="NAME|FILE", help="beside bicubic")
    parser.add_argument("--providers", nargs="+", choices=PROVIDERS, default=["cpu"], help="runtimes (default: cpu)")
    parser.add_argument("--scale", type=int, choices=(2, 3), default=2)
    parser.add_argument("--degradations", nargs="+", default=["area", "area@8000"], metavar="HOW", help="inputs (default: %(default)s)")
    parser.add_argument("--frames", type=whole_number(), default=24, help="of each scene, from its start (default: %(default)s)")
    parser.add_argument(
        "--timed-frames",
        type=_timed_frames,
        default=30,
        help=f"frames of a timed run, {FEWEST_TIMED_FRAMES} at least (default: %(default)s)",
    )
    parser.add_argument("--rounds", type=whole_number(), default=5, help="timed runs of each (default: %(default)s)")
    parser.add_argument("--threads", type=whole_number(most=1024), help="threads of the models (default: the physical cores)")
    parser.add_argument("--rows", type=Path, default=Path("runs/evaluation.jsonl"), help="measured rows, kept (default: %(default)s)")
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="decoded footage, may be deleted (default: %(default)s)")
    parser.add_argument("--svg", type=Path, metavar="FILE", help="draw it")
    parser.add_argument("--json", action="store_true", help="a JSON line for each model on each runtime instead of the tables")
    return parser


def _timed_frames(text: str) -> int:
    count = int(text)
    if count < FEWEST_TIMED_FRAMES:
        raise argparse.ArgumentTypeError(f"the p95 of {count} frames is their slowest: time {FEWEST_TIMED_FRAMES} or more")
    return count


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = parser()
    arguments = command.parse_args(argv)

    def work() -> None:
        if arguments.svg and not arguments.svg.parent.is_dir():
            raise OutputError(f"{arguments.svg.parent} is not a folder: make it, or name another with --svg")
        candidates = measure(arguments)
        for candidate in candidates if arguments.json else ():
            print(json.dumps(asdict(candidate)))
        for degradation in () if arguments.json else candidates[0].gains:
            print(f"Input {degradation}:\n\n{table(candidates, degradation)}\n")
        if arguments.svg:
            write_whole(arguments.svg, drawing(candidates))

    return run_command(
        PROGRAM, work, debug=arguments.debug, interrupted=f"stopped; the same command goes on from the rows in {arguments.rows}"
    )
