"""gamesr-refit: an artifact whose last layer is solved on footage."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import torch
from tqdm import tqdm

from client.command import command_parser, run_command, whole_number
from client.models import WEIGHTS, find_model
from model.artifact_files import new_artifacts
from model.cards import card_page
from model.footage import Degradation, FootageCache, load_pairs, load_scenes
from model.refit import FRAMES, Refit, sums_of

DEGRADATIONS = ("area", "area", "area", "area@8000", "area@4000", "native@4000")
EPILOG = """\
example:
  gamesr-refit client/weights/live_x2.onnx mine footage/footage.toml

It plays every training scene through the network, takes down how what the last layer reads goes with the errors that are left, and
solves for the weights of that layer which leave the least. The table is what that does to PSNR in dB on the held-out scenes, before
rounding to codes. Every other layer, and what a frame takes, stays as it is; of an int8 model refit the float32 one, and quantize it.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = command_parser(
        "gamesr-refit", "Write an artifact like another, whose last layer leaves the least error on the training scenes.", EPILOG
    )
    parser.add_argument("model", metavar="NAME|FILE", help="a shipped float32 model, or the .onnx artifact of a trained GameSR network")
    parser.add_argument("name", help="the new model's name; its files are NAME_xSCALE.onnx and .md")
    parser.add_argument("footage", type=Path, help="the footage list, a TOML file")
    parser.add_argument(
        "--degradations",
        nargs="+",
        default=list(DEGRADATIONS),
        metavar="HOW",
        help=f"as of gamesr-train; twice counts twice (default: {' '.join(DEGRADATIONS)})",
    )
    parser.add_argument("--cache", type=Path, default=Path("runs/cache"), help="decoded footage, may be deleted (default: %(default)s)")
    parser.add_argument("--threads", type=whole_number(most=1024), help="CPU threads (default: all)")
    parser.add_argument("--folder", type=Path, default=WEIGHTS, help="where to (default: %(default)s)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    arguments = parser.parse_args(argv)

    def work() -> None:
        if arguments.threads:
            torch.set_num_threads(arguments.threads)
        model = find_model(arguments.model, 2)
        refit = Refit(model)
        scale = refit.spec.scale
        (path,) = new_artifacts(arguments.name, [scale], arguments.folder, source=model, force=arguments.force)
        degradations = [Degradation.parse(text) for text in arguments.degradations]
        cache = FootageCache(arguments.cache, FRAMES)
        splits = {split: load_scenes(arguments.footage, split=split) for split in ("train", "validate")}
        with tqdm(total=sum(map(len, splits.values())), unit="scene", disable=not sys.stderr.isatty()) as bar:
            for split, sums in (("train", refit.train), ("validate", refit.held_out)):
                for scene in splits[split]:
                    for pair in (pair for takes in load_pairs([scene], cache, scale, dict.fromkeys(degradations)) for pair in takes):
                        sums[pair.title] = sums_of(refit.network, refit.layer, pair)
                    bar.update()
        gains = refit.solve([str(how) for how in degradations])
        facts = {"degradations": [str(how) for how in degradations], "frames": FRAMES, "scenes": [scene.title for scene in splits["train"]]}
        refit.write(path, name=arguments.name, facts=facts, page=card_page)
        print("| held out | input | PSNR-Y | PSNR-U | PSNR-V |\n|---|---|---|---|---|")
        for (game, how), rows in _by_game(gains).items():
            print(f"| {game} | {how} | " + " | ".join(f"{fmean(plane):+.3f}" for plane in zip(*rows, strict=True)) + " |")
        print(path)

    return run_command(parser.prog, work, debug=arguments.debug, interrupted="stopped; what is decoded is kept")


def _by_game(gains: dict[str, list[float]]) -> dict[tuple[str, str], list[list[float]]]:
    groups: dict[tuple[str, str], list[list[float]]] = {}
    for title, row in gains.items():
        scene, how = title.split()
        groups.setdefault((scene.split("/")[0], how), []).append(row)
    return groups
