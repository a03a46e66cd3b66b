"""gamesr-train, gamesr-verify and gamesr-evaluate: weights from footage, and figures from both."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, fields
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from client.artifact import load_session
from client.command import command_parser, run_command, whole_number
from client.errors import InputError, ModelError
from client.models import find_model
from client.runtime import PROVIDERS
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from model.artifact_weights import network_of_artifact
from model.catalogue import NAMES
from model.evaluate import evaluate, left_out, table
from model.footage import Degradation, FootageCache, load_scenes
from model.losses import LOSSES
from model.stability import CASES, CLIP_FRAMES, HEADER, run_cases, table_row
from model.train import TrainConfig, Trainer
from model.trial import SHOWN_STEPS, Subject, bounds_of, broken_by
from model.verify import PARITY_HEADER, StepError, crop, parity, parity_row, parse_size

TRAIN_EXAMPLES = """\
The footage list is a TOML file of scenes (gamesr-footage makes one); scenes are split by map or track. A run lives in one
folder and goes on where it stopped when the same command is given again.

examples:
  gamesr-train footage.toml runs/openarena_x2 --games openarena --steps 20000
  gamesr-train footage.toml runs/paper_x3 --preset paper --scale 3 --device cuda
  gamesr-train my_game.toml runs/my_live_x2 --preset live --initial-weights client/weights/live_x2.onnx --learning-rate 0.0003
  gamesr-train my_game.toml runs/my_fast_x2 --preset fast --initial-weights client/weights/fast_x2.onnx --learning-rate 0.0003 --int8
  gamesr-train my_game.toml runs/my_wide_x2 --preset live-wide --initial-weights client/weights/live_x2.onnx --int8

live-wide and balanced-wide are what 8 bits run in as much time as live and balanced; they go on from the weights of those too.
"""

VERIFY_EXAMPLES = """\
examples:
  gamesr-verify gamesr tests/footage/oa_koth1_540p.mp4
  gamesr-verify gamesr tests/footage/oa_koth1_540p.mp4 --provider cpu openvino openvino-bfloat16
  gamesr-verify live_x3 tests/footage/oa_koth1_540p.mp4 --hard short
  gamesr-verify client/weights/gamesr_x2.onnx --hard full --cases still fade

hard cases (docs/stability.md says more):
"""


def train_main(argv: Sequence[str] | None = None) -> int:
    defaults = {f.name: f.default for f in fields(TrainConfig)}
    parser = command_parser(
        "gamesr-train",
        "Train a GameSR network, or a published one beside it, on game footage degraded as a cloud encoder degrades it.",
        TRAIN_EXAMPLES,
    )
    parser.add_argument("footage", type=Path, help="the footage list, a TOML file")
    parser.add_argument("run", type=Path, help="the run's folder: checkpoint.pt and log.jsonl")
    parser.add_argument("--preset", choices=sorted(NAMES), default=defaults["preset"], help="the network (default: %(default)s)")
    parser.add_argument("--scale", type=int, choices=(2, 3), default=defaults["scale"], help="upscaling factor (default: %(default)s)")
    parser.add_argument("--games", nargs="+", default=[], metavar="GAME", help="train on these games only (default: all)")
    parser.add_argument(
        "--degradations",
        nargs="+",
        default=defaults["degradations"],
        metavar="HOW",
        help="area, native, native:aa (against the anti-aliased reference), area@4000 (x264 at 4000 kbps)...; twice is twice as often "
        "(default: %(default)s)",
    )
    for name, least, text in (
        ("steps", 1, "optimizer updates"),
        ("batch", 1, "clips in a batch"),
        ("patch", 1, "side of a crop in low-resolution pixels"),
        ("frames", 1, "frames of a clip, over which the state is carried"),
        ("window", 1, "frames of one step, through which gradients flow"),
        ("halvings", 0, "how often the learning rate is halved over the run"),
        ("seed", 0, "of weights and crops"),
    ):
        parser.add_argument(f"--{name}", type=whole_number(least), default=defaults[name], help=f"{text} (default: %(default)s)")
    parser.add_argument("--learning-rate", type=float, default=defaults["learning_rate"], help="AdamW's first rate (default: %(default)s)")
    parser.add_argument(
        "--loss",
        choices=LOSSES,
        default=defaults["loss"],
        help="charbonnier, the paper's, sums errors up; psnr their logarithms by clip and plane (default: %(default)s)",
    )
    parser.add_argument("--bfloat16", action="store_true", help="mixed precision: about twice as fast on AMX CPUs and on GPUs")
    parser.add_argument(
        "--int8", action="store_true", help="train for 8 bits: their rounding is part of the error (fast, live, balanced, wide or not)"
    )
    parser.add_argument(
        "--initial-weights",
        default="",
        metavar="FILE",
        help="start from another run's checkpoint.pt or from an artifact (client/weights/live_x2.onnx), as far as shapes fit",
    )
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="decoded footage, may be deleted (default: %(default)s)")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu or cuda (default here: %(default)s)")
    parser.add_argument("--threads", type=whole_number(most=1024), help="CPU threads (default: all)")
    parser.add_argument("--compile", action="store_true", help="torch.compile: a quarter faster after a minute; needs a C++ compiler")
    parser.add_argument(
        "--validate-every", type=whole_number(), default=1000, metavar="STEPS", help="held-out PSNR and a checkpoint (default: %(default)s)"
    )
    arguments = parser.parse_args(argv)
    names = {f.name for f in fields(TrainConfig)}
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in vars(arguments).items() if k in names}

    def work() -> None:
        if arguments.threads:
            torch.set_num_threads(arguments.threads)
        trainer = Trainer(
            TrainConfig(**given),
            arguments.footage,
            FootageCache(arguments.cache),
            arguments.run,
            device=arguments.device,
            compiled=arguments.compile,
        )
        trainer.run(validate_every=arguments.validate_every, progress=sys.stderr.isatty())

    return run_command(
        parser.prog,
        work,
        debug=arguments.debug,
        interrupted=f"stopped; the same command goes on from the last checkpoint in {arguments.run}",
    )


def verify_main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser(
        "gamesr-verify",
        "Hold an artifact in ONNX Runtime against its own weights in torch float64, over many recurrent steps of a clip; "
        "with --hard, over pictures and states that are hard on a recurrent network. Exits 1 when it breaks a bound of its precision.",
        VERIFY_EXAMPLES + "".join(f"  {case.name:14} {case.what}\n" for case in CASES),
    )
    parser.add_argument(
        "model",
        metavar="NAME|FILE",
        help="a shipped model, such as live or live_x3, or a trained artifact; with --hard a baseline too",
    )
    parser.add_argument("clip", type=Path, nargs="?", help="a low-resolution video; it is played forwards and backwards")
    parser.add_argument("--steps", type=whole_number(), default=300, help="recurrent steps, without --hard (default: %(default)s)")
    parser.add_argument(
        "--crop",
        metavar="WxH",
        help="the middle of the picture, both even (default: 192x108; of hard cases 64x48 in short, 160x96 in full)",
    )
    parser.add_argument("--hard", choices=("short", "full"), help="the hard cases: short takes seconds, full up to 10,000 frames a case")
    parser.add_argument("--cases", nargs="+", choices=[case.name for case in CASES], metavar="CASE", help="only these hard cases")
    parser.add_argument(
        "--provider",
        nargs="+",
        choices=PROVIDERS,
        default=["cpu"],
        metavar="PROVIDER",
        help=f"what runs the artifact, of {', '.join(PROVIDERS)}; of the hard cases one, else any number beside each other (default: cpu)",
    )
    parser.add_argument(
        "--weights", type=Path, metavar="FLOAT32", help="the .onnx artifact that an int8 one was made from, where that does not ship"
    )
    parser.add_argument("--json", action="store_true", help="a JSON line a step and provider, or a hard case, instead of the table")
    arguments = parser.parse_intermixed_args(argv)  # options between MODEL and CLIP too
    if arguments.hard is None and (arguments.clip is None or arguments.cases):
        parser.error("CLIP may be left out, and --cases given, with --hard only")
    if arguments.hard and len(arguments.provider) > 1:
        parser.error("--hard takes one --provider")

    def work() -> None:
        arguments.model = find_model(arguments.model, 2)
        if arguments.hard:
            _verify_hard(arguments)
        else:
            _verify_parity(arguments)

    return run_command(parser.prog, work, debug=arguments.debug, interrupted="stopped")


def _verify_parity(arguments: argparse.Namespace) -> None:
    width, height = parse_size(arguments.crop or "192x108")
    frames = [crop(frame, width, height) for frame in islice(read_frames(arguments.clip), arguments.steps)]
    if not frames:
        raise InputError(f"no frame of {arguments.clip} could be decoded")
    _, spec = load_session(arguments.model, "cpu", 1)
    bounds = {provider: bounds_of(spec, provider) for provider in arguments.provider}
    errors: dict[str, list[StepError]] = {provider: [] for provider in arguments.provider}
    for error in parity(arguments.model, frames, arguments.steps, providers=list(errors), weights=arguments.weights):
        if not any(errors.values()) and not arguments.json:  # with the first row: what is refused before it has no table
            print(PARITY_HEADER)
        errors[error.provider].append(error)
        if arguments.json:
            print(json.dumps(asdict(error)))
        elif error.step in (*SHOWN_STEPS, arguments.steps):
            print(parity_row(f"{error.step:,}", [error]), flush=True)
    if not arguments.json:
        print("\n".join(parity_row("any", of_provider) for of_provider in errors.values()))
    broken = [f"on {provider} {what}" for provider in errors for what in broken_by(errors[provider], bounds[provider])]
    if broken:
        raise ModelError(f"{arguments.model} is too far from its float64 reference: {'; '.join(broken)}")


def _verify_hard(arguments: argparse.Namespace) -> None:
    full = arguments.hard == "full"
    width, height = parse_size(arguments.crop or ("160x96" if full else "64x48"))
    upscaler = OnnxUpscaler(arguments.model, provider=arguments.provider[0])
    network = network_of_artifact(arguments.model, arguments.weights) if "network" in upscaler.spec.card else None
    clip = list(islice(read_frames(arguments.clip), CLIP_FRAMES[full])) if arguments.clip else []
    if arguments.clip and not clip:
        raise InputError(f"no frame of {arguments.clip} could be decoded")
    subject = Subject(arguments.model, upscaler, network, clip, width, height, full, progress=sys.stderr.isatty())
    about = {"model": arguments.model.name, "sha256": upscaler.spec.sha256, "provider": upscaler.provider, "length": arguments.hard}
    if not arguments.json:
        print(HEADER, flush=True)
    failed = []
    for case, outcome in run_cases(subject, [case for case in CASES if case.name in (arguments.cases or [case.name])]):
        print(json.dumps({**about, "case": case.name, **outcome.record()}) if arguments.json else table_row(case, outcome), flush=True)
        if outcome.failures:
            failed.append(case.name)
    if failed:
        raise ModelError(f"{arguments.model} fails {len(failed)} of the hard cases: {', '.join(failed)}")


def evaluate_main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser(
        "gamesr-evaluate",
        "Measure models on test scenes: downscaled, encoded as a cloud encoder does, upscaled, held against the reference.",
        "example:\n  gamesr-evaluate tests/footage/footage.toml --models bicubic lanczos gamesr --scales 2",
    )
    parser.add_argument("footage", type=Path, help="the footage list, a TOML file")
    parser.add_argument("--split", choices=("validate", "test"), default="test", help="which scenes (default: %(default)s)")
    parser.add_argument("--games", nargs="+", default=[], metavar="GAME", help="these games only (default: all)")
    parser.add_argument("--models", nargs="+", default=["bicubic", "lanczos", "gamesr-paper", "gamesr"], metavar="NAME|FILE")
    parser.add_argument("--scales", nargs="+", type=int, choices=(2, 3), default=[2, 3])
    parser.add_argument("--degradations", nargs="+", default=["area", "area@8000", "area@4000"], metavar="HOW")
    parser.add_argument("--frames", type=whole_number(), default=60, help="of each scene, from its start (default: %(default)s)")
    parser.add_argument("--provider", choices=PROVIDERS, default="cpu", help="what runs the models (default: %(default)s)")
    parser.add_argument("--threads", type=whole_number(most=1024), help="threads of the network (default: the physical cores)")
    parser.add_argument("--rows", type=Path, default=Path("runs/evaluation.jsonl"), help="measured rows, kept (default: %(default)s)")
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="decoded footage, may be deleted (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="a JSON line a row instead of the table")
    arguments = parser.parse_args(argv)

    def work() -> None:
        scenes = load_scenes(arguments.footage, split=arguments.split, games=arguments.games)
        degradations = [Degradation.parse(text) for text in arguments.degradations]
        arguments.rows.parent.mkdir(parents=True, exist_ok=True)
        rows = evaluate(
            scenes,
            FootageCache(arguments.cache, arguments.frames),
            models=arguments.models,
            scales=arguments.scales,
            degradations=degradations,
            provider=arguments.provider,
            threads=arguments.threads,
            store=arguments.rows,
        )
        total = len(scenes) * len(arguments.scales) * len(degradations) * len(arguments.models)
        measured = []
        for row in tqdm(rows, total=total, unit="row", disable=not sys.stderr.isatty()):
            measured.append(row)
            if arguments.json:
                print(json.dumps(row), flush=True)
        if not measured:
            raise InputError(f"no scene of {arguments.footage} was rendered for {' or '.join(arguments.degradations)}")
        for sentence in left_out(measured, scenes, degradations, arguments.frames):
            print(f"{parser.prog}: {sentence}", file=sys.stderr)
        if not arguments.json:
            print(table(measured))

    return run_command(
        parser.prog, work, debug=arguments.debug, interrupted=f"stopped; the same command goes on from the rows in {arguments.rows}"
    )
