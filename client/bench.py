"""gamesr-bench: how fast each model is on this machine, stage by stage, beside bicubic and Lanczos."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import onnxruntime

from client.command import command_parser, run_command, whole_number
from client.measurement import WARM_UP_FRAMES, Run, Task, measure_in_fresh_process
from client.models import find_model, shipped_models
from client.runtime import PROVIDERS
from client.synthetic import write_synthetic_clip
from client.timing import LatencySummary
from client.upscaler import OnnxUpscaler

PROGRAM = "gamesr-bench"
SIZES = ((640, 360), (960, 540))
YARDSTICK = "bicubic"
BASELINES = (YARDSTICK, "lanczos")
EPILOG = f"""\
examples:
  gamesr-bench
      every shipped model, on a made clip at 640x360 and 960x540
  gamesr-bench --model gamesr --threads 2
      one model beside the baselines, on two threads
  gamesr-bench --clip match_540p.mp4 --json
      on a stream of yours, every figure in one JSON object

how it is measured:
  Every run has a fresh process, and the models take turns in every round, so that a busy moment of the machine does not
  fall on one of them alone. Each figure is the median over the rounds of that round's figure; max and memory are the
  largest. The first {WARM_UP_FRAMES} frames are warm-up and count only for "first": the time to load the model and that of its first
  step. "vs {YARDSTICK}" compares the p95 of upscale. Memory is the peak of the whole process. Parameters and GMAC
  (10^9 multiply-accumulates of a frame, by trained convolutions) are what the model's card says. Nothing is encoded: write is
  the handing over of the picture. A player upscales 640x360 by 3 or 960x540 by 2 to reach 1920x1080.

Exit status: 0 done, 1 refused or failed (one sentence says why), 2 wrong usage, 130 interrupted.
"""


@dataclass(frozen=True)
class Result:
    """One model at one input size: its runs, one a round, pooled as the help says."""

    runs: Sequence[Run]
    yardstick: Sequence[Run]

    @property
    def title(self) -> str:
        return f"{self.runs[0].spec.name} x{self.runs[0].spec.scale}"

    @property
    def complexity(self) -> tuple[str, str]:
        """Parameters, and multiply-accumulates of a frame of this size, in words; empty where the model's card does not say."""
        run = self.runs[0]
        parameters, macs = run.spec.card.get("parameters"), run.spec.card.get("macs_540p")
        here = None if macs is None else macs * (run.width * run.height) / (960 * 540)
        return "" if parameters is None else f"{parameters / 1e3:.1f}K parameters", "" if here is None else f"{here / 1e9:.1f} GMAC"

    @property
    def fps(self) -> float:
        return statistics.median(run.fps for run in self.runs)

    @property
    def first_frame_ms(self) -> float:
        return statistics.median(run.first_frame_ms for run in self.runs)

    @property
    def peak_memory_mib(self) -> float | None:
        return max((run.peak_memory_mib for run in self.runs if run.peak_memory_mib is not None), default=None)

    @property
    def ratio(self) -> float:
        """The p95 of upscale over that of the yardstick at the same size and scale."""
        ours, theirs = (statistics.median(run.latency_us["upscale"].p95 for run in runs) for runs in (self.runs, self.yardstick))
        return ours / theirs

    def latency_us(self) -> dict[str, dict[str, float]]:
        """By stage: p50, p95, p99, max."""
        return {stage: _pool([run.latency_us[stage] for run in self.runs]) for stage in self.runs[0].latency_us}

    def record(self) -> dict[str, object]:
        """Every figure, ready for JSON."""
        run = self.runs[0]
        return {
            "model": {
                "name": run.spec.name,
                "sha256": run.spec.sha256,
                "scale": run.spec.scale,
                "precision": run.spec.precision,
                "parameters": run.spec.card.get("parameters"),
                "macs_540p": run.spec.card.get("macs_540p"),
            },
            "input": {"width": run.width, "height": run.height},
            "frames": run.latency_us["total"].count,
            "latency_us": self.latency_us(),
            "upscale_p95_us_by_round": [run.latency_us["upscale"].p95 for run in self.runs],
            f"upscale_p95_vs_{YARDSTICK}": self.ratio,
            "fps": self.fps,
            "first_frame_ms": self.first_frame_ms,
            "peak_memory_mib": self.peak_memory_mib,
        }


def _pool(summaries: Sequence[LatencySummary]) -> dict[str, float]:
    medians = {name: statistics.median(getattr(summary, name) for summary in summaries) for name in ("p50", "p95", "p99")}
    return {**medians, "max": max(summary.max for summary in summaries)}


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Time the models on this machine, stage by stage, beside bicubic and Lanczos.", EPILOG)
    parser.add_argument(
        "--model",
        metavar="NAME|FILE",
        action="append",
        help="a shipped model at every scale it has, or an .onnx file; repeatable (default: all)",
    )
    parser.add_argument("--clip", metavar="FILE", type=Path, help="the video to upscale (default: a made one, at two sizes)")
    parser.add_argument("--frames", metavar="N", type=whole_number(), default=30, help="frames that count in a run (default: %(default)s)")
    parser.add_argument("--rounds", metavar="N", type=whole_number(), default=5, help="runs of every model (default: %(default)s)")
    parser.add_argument("--provider", choices=PROVIDERS, default="cpu", help="what runs the models (default: %(default)s)")
    parser.add_argument("--threads", metavar="N", type=whole_number(most=1024), help="threads of the model (default: the physical cores)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)

    def work() -> None:
        try:
            results = bench(arguments)
        finally:
            _progress("")
        print(json.dumps(_record(results, arguments)) if arguments.json else _table(results, arguments), flush=True)

    return run_command(PROGRAM, work, debug=arguments.debug)


def bench(arguments: argparse.Namespace) -> list[Result]:
    """Every model at every size over all rounds, by size, then scale, the baselines first; raises GamesrError."""
    models = _models(arguments.model)
    runs: dict[tuple[Path, Path], list[Run]] = {}
    with tempfile.TemporaryDirectory(prefix="gamesr-bench-") as folder:
        clips = [arguments.clip] if arguments.clip else _made_clips(Path(folder), arguments.frames)
        for number in range(1, arguments.rounds + 1):
            for clip in clips:
                for model in models:
                    _progress(f"round {number} of {arguments.rounds}: {model.stem} on {clip.stem}")
                    run = measure_in_fresh_process(Task(model, clip, arguments.frames, arguments.provider, arguments.threads))
                    runs.setdefault((clip, model), []).append(run)
    yardsticks = {(clip, of[0].spec.scale): of for (clip, model), of in runs.items() if model == find_model(YARDSTICK, of[0].spec.scale)}
    return [Result(of, yardsticks[clip, of[0].spec.scale]) for (clip, _), of in runs.items()]


def _models(names: Sequence[str] | None) -> list[Path]:
    """By scale, in each the baselines first; the baselines of every scale that is asked for."""
    asked = [path for name in names for path in _named(name)] if names else shipped_models()
    by_scale: dict[int, list[Path]] = {}
    for path in asked:
        by_scale.setdefault(OnnxUpscaler(path, threads=1).spec.scale, []).append(path)
    return [
        path
        for scale, paths in sorted(by_scale.items())
        for path in dict.fromkeys([*(find_model(name, scale) for name in BASELINES), *paths])
    ]


def _named(name: str) -> list[Path]:
    shipped = [path for path in shipped_models() if path.stem.rpartition("_x")[0] == name]
    return shipped or [find_model(name, 2)]


def _made_clips(folder: Path, frames: int) -> list[Path]:
    clips = []
    for width, height in SIZES:
        _progress(f"making a clip of {width}x{height}")
        clips.append(folder / f"{width}x{height}.h264")
        write_synthetic_clip(clips[-1], width, height, WARM_UP_FRAMES + frames)
    return clips


def _record(results: Sequence[Result], arguments: argparse.Namespace) -> dict[str, object]:
    return {
        "provider": arguments.provider,
        "threads": results[0].runs[0].threads,
        "onnxruntime": onnxruntime.__version__,
        "clip": str(arguments.clip) if arguments.clip else "synthetic",
        "rounds": arguments.rounds,
        "warm_up_frames": WARM_UP_FRAMES,
        "results": [result.record() for result in results],
    }


def _table(results: Sequence[Result], arguments: argparse.Namespace) -> str:
    first = results[0].runs[0]
    frames = first.latency_us["total"].count
    lines = [
        f"{arguments.provider}, threads {first.threads}, ONNX Runtime {onnxruntime.__version__}, {arguments.clip or 'a made clip'}",
        f"{arguments.rounds} rounds of {frames} frames, each after {WARM_UP_FRAMES} of warm-up; times in ms, medians over the rounds",
    ]
    size = None
    for result in results:
        run = result.runs[0]
        if size != (run.width, run.height):
            size = run.width, run.height
            heads = ("p50", "p95", "p99", "max", "frames/s", f"vs {YARDSTICK}", "first", "peak MiB")
            lines += ["", f"{f'{size[0]}x{size[1]} in':<28}" + "".join(f"{head:>12}" for head in heads)]
        parameters, macs = result.complexity
        for label, (stage, latency) in zip((result.title, f"  {parameters}", f"  {macs}", ""), result.latency_us().items(), strict=True):
            lines.append(f"{label:<20}{stage:<8}" + "".join(f"{value / 1000:>12.2f}" for value in latency.values()))
        memory = "-" if result.peak_memory_mib is None else f"{result.peak_memory_mib:.0f}"
        lines[-1] += f"{result.fps:>12.1f}{result.ratio:>12.2f}{result.first_frame_ms:>12.1f}{memory:>12}"
    return "\n".join(lines)


def _progress(line: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{line}")
        sys.stderr.flush()
