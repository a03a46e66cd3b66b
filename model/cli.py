"""gamesr-train: weights from footage."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from client.errors import GamesrError
from model.footage import FootageCache
from model.network import PRESETS
from model.train import TrainConfig, Trainer

TRAIN_EXAMPLES = """\
The footage list is a TOML file of scenes (see model/footage.py); scenes are split by map or track. A run lives in one
folder and goes on where it stopped when the same command is given again:

  gamesr-train footage.toml runs/openarena_x2 --games openarena --steps 20000
  gamesr-train footage.toml runs/paper_x3 --preset paper --scale 3 --device cuda
"""


def train_main(argv: Sequence[str] | None = None) -> int:
    defaults = {f.name: f.default for f in fields(TrainConfig)}
    parser = argparse.ArgumentParser(
        prog="gamesr-train",
        description="Train a GameSR network on game footage degraded as a cloud encoder degrades it.",
        epilog=TRAIN_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("footage", type=Path, help="the footage list, a TOML file")
    parser.add_argument("run", type=Path, help="the run's folder: checkpoint.pt and log.jsonl")
    parser.add_argument("--preset", choices=sorted(PRESETS), default=defaults["preset"], help="the network (default: %(default)s)")
    parser.add_argument("--scale", type=int, choices=(2, 3), default=defaults["scale"], help="upscaling factor (default: %(default)s)")
    parser.add_argument("--games", nargs="+", default=[], metavar="GAME", help="train on these games only (default: all)")
    parser.add_argument(
        "--degradations",
        nargs="+",
        default=defaults["degradations"],
        metavar="HOW",
        help="area, native, area@4000 (x264 at 4000 kbps)...; twice is twice as often (default: %(default)s)",
    )
    for name, text in (
        ("steps", "optimizer updates"),
        ("batch", "clips in a batch"),
        ("patch", "side of a crop in low-resolution pixels"),
        ("frames", "frames of a clip, over which the state is carried"),
        ("window", "frames of one step, through which gradients flow"),
        ("halvings", "how often the learning rate is halved over the run"),
        ("seed", "of weights and crops"),
    ):
        parser.add_argument(f"--{name}", type=int, default=defaults[name], help=f"{text} (default: %(default)s)")
    parser.add_argument("--learning-rate", type=float, default=defaults["learning_rate"], help="AdamW's first rate (default: %(default)s)")
    parser.add_argument("--bfloat16", action="store_true", help="mixed precision: about twice as fast on AMX CPUs and on GPUs")
    parser.add_argument("--initial-weights", default="", metavar="CHECKPOINT", help="start from another run's checkpoint.pt")
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="decoded footage, may be deleted (default: %(default)s)")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu or cuda (default here: %(default)s)")
    parser.add_argument("--threads", type=int, help="CPU threads (default: all)")
    parser.add_argument("--compile", action="store_true", help="torch.compile: a quarter faster after a minute; needs a C++ compiler")
    parser.add_argument(
        "--validate-every", type=int, default=1000, metavar="STEPS", help="held-out PSNR and a checkpoint (default: %(default)s)"
    )
    parser.add_argument("--debug", action="store_true", help="show the trace of an error")
    arguments = parser.parse_args(argv)
    names = {f.name for f in fields(TrainConfig)}
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in vars(arguments).items() if k in names}
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    try:
        trainer = Trainer(
            TrainConfig(**given),
            arguments.footage,
            FootageCache(arguments.cache),
            arguments.run,
            device=arguments.device,
            compiled=arguments.compile,
        )
        trainer.run(validate_every=arguments.validate_every, progress=sys.stderr.isatty())
    except GamesrError as error:
        if arguments.debug:
            raise
        print(f"gamesr-train: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"gamesr-train: stopped; the same command goes on from the last checkpoint in {arguments.run}", file=sys.stderr)
        return 130
    return 0
