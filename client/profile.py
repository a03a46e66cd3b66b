"""gamesr-profile: where a frame's microseconds go inside a model, operation by operation, as the runtime itself counts them."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from client.artifact import ModelSpec, load_session, read_artifact, session_options
from client.command import command_parser, run_command, whole_number
from client.cores import physical_cores
from client.frames import plane_shapes
from client.models import DEFAULT_MODEL, find_model
from client.runtime import OPENVINO, OpenVinoRuntime

PROGRAM = "gamesr-profile"
PROFILED = ("cpu", *OPENVINO)
EPILOG = """\
example:
  gamesr-profile --model live --provider openvino-bfloat16

Every operation that takes a hundredth of the frame or more, in the order of execution; a runtime joins several of the model's
operations in one, and may name it after the last. Medians over frames of noise, the state carried, after a warm-up. Counting
makes every operation a little slower: what a whole frame takes, with decoding and hand-over, is what gamesr-bench says.
A frame is 960x540 for x2 and 640x360 for x3.

Exit status: 0 done, 1 refused or failed (one sentence says why), 2 wrong usage, 130 interrupted.
"""
WARM_UP_FRAMES = 5
LEAST_SHARE = 0.01
SIZES = {2: (540, 960), 3: (360, 640)}

Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True)
class Part:
    """An operation as it is executed and its time in microseconds a frame."""

    name: str
    operation: str
    us: float


def profile(model: Path, provider: str, threads: int, frames: int) -> tuple[ModelSpec, list[Part]]:
    """The model's operations in the order of execution, medians over `frames`; `provider` is one of PROFILED. Raises GamesrError."""
    _, spec = load_session(model, "cpu", 1)
    inputs = _inputs(spec, *SIZES[spec.scale])
    runs = _openvino_runs if provider in OPENVINO else _onnxruntime_runs
    times: dict[tuple[str, str], list[float]] = {}
    for parts in runs(read_artifact(model), spec, inputs, WARM_UP_FRAMES + frames, threads, provider):
        for part in parts:
            times.setdefault((part.name, part.operation), []).append(part.us)
    return spec, [Part(*key, statistics.median(us[WARM_UP_FRAMES:])) for key, us in times.items()]


def _inputs(spec: ModelSpec, height: int, width: int) -> Arrays:
    random = np.random.default_rng(0)
    height, width = spec.padded(height), spec.padded(width)
    planes = zip(("y", "u", "v"), plane_shapes(height, width), strict=True)
    states = {s.input: np.zeros((1, s.channels, height // s.divisor, width // s.divisor), s.dtype) for s in spec.state}
    return {**{name: random.integers(0, 256, (1, 1, *shape), np.uint8) for name, shape in planes}, **states}


def _onnxruntime_runs(content: bytes, spec: ModelSpec, inputs: Arrays, count: int, threads: int, provider: str) -> Iterator[list[Part]]:
    options = session_options(threads)
    with tempfile.TemporaryDirectory(prefix="gamesr-profile-") as folder:
        options.enable_profiling, options.profile_file_prefix = True, f"{folder}/profile"
        session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        names = [output.name for output in session.get_outputs()]
        for _ in range(count):
            outputs = dict(zip(names, session.run(None, inputs), strict=True))
            inputs |= {state.input: outputs[state.output] for state in spec.state}
        events = json.loads(Path(session.end_profiling()).read_text())
    parts = [
        Part(event["name"].removesuffix("_kernel_time"), event["args"]["op_name"], event["dur"])
        for event in events
        if event["cat"] == "Node" and event["name"].endswith("_kernel_time")
    ]
    for first in range(0, len(parts), len(parts) // count):
        yield parts[first : first + len(parts) // count]


def _openvino_runs(content: bytes, spec: ModelSpec, inputs: Arrays, count: int, threads: int, provider: str) -> Iterator[list[Part]]:
    runtime = OpenVinoRuntime(content, threads=threads, provider=provider, counting=True)
    request = runtime.request({name: array.shape for name, array in inputs.items()})
    for _ in range(count):
        request.infer(inputs)
        inputs |= {state.input: request.get_tensor(state.output).data.copy() for state in spec.state}
        yield [
            Part(info.node_name, f"{info.node_type} ({info.exec_type})", info.real_time.total_seconds() * 1e6)
            for info in request.profiling_info
            if info.real_time
        ]


def table(parts: Sequence[Part]) -> str:
    """Markdown: what takes a hundredth or more, the rest in one row, the sum."""
    total_us = sum(part.us for part in parts)
    shown = [part for part in parts if part.us >= LEAST_SHARE * total_us]
    rest_us = total_us - sum(part.us for part in shown)
    rows = [(part.name, part.operation, part.us) for part in shown]
    rows += [(f"{len(parts) - len(shown)} more", "", rest_us), ("all", "", total_us)]
    lines = ["| operation | kind | us | share |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {name} | {kind} | {us:.0f} | {us / total_us:.1%} |" for name, kind, us in rows)])


def parser() -> argparse.ArgumentParser:
    parser = command_parser(PROGRAM, "Count what each operation of a model takes on this machine.", EPILOG)
    parser.add_argument(
        "--model", metavar="NAME|FILE", default=DEFAULT_MODEL, help="a shipped model or an .onnx file (default: %(default)s)"
    )
    parser.add_argument("--scale", type=int, choices=(2, 3), default=2, help="of a shipped model (default: %(default)s)")
    parser.add_argument("--provider", choices=PROFILED, default="cpu", help="what runs the model (default: %(default)s)")
    parser.add_argument("--threads", metavar="N", type=whole_number(most=1024), help="threads of the model (default: the physical cores)")
    parser.add_argument("--frames", metavar="N", type=whole_number(), default=30, help="frames that count (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="a JSON line an operation instead of the table")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    arguments = parser().parse_args(argv)
    threads = arguments.threads or physical_cores()

    def work() -> None:
        spec, parts = profile(find_model(arguments.model, arguments.scale), arguments.provider, threads, arguments.frames)
        for part in parts if arguments.json else ():
            print(json.dumps(asdict(part)))
        if not arguments.json:
            print(f"{spec.name} x{spec.scale} on {arguments.provider}, threads {threads}\n\n{table(parts)}")
        sys.stdout.flush()

    return run_command(PROGRAM, work, debug=arguments.debug)
