"""gamesr-footage: films free games, so that anyone can make the training and test footage again."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm import tqdm

from client.command import command_parser, run_command, whole_number
from client.cores import physical_cores
from client.errors import InputError
from model.capture.display import hidden_display
from model.capture.filming import WINDOW, Shot, build_frame_clock, film, record
from model.capture.games import GAMES, HEIGHTS, SPLITS, SceneSpec, choose, load_games
from model.capture.library import Library, frames_digest
from model.capture.rendering import CLOCKS, FramesDone, SceneDone, render, shots_of

PROGRAM = "gamesr-footage"
EPILOG = """\
WHAT is a game (openarena), a scene (openarena/oa_koth1) or a split (train, validate, test); everything when it is left out.

examples:
  gamesr-footage list
      the games, their scenes and what each is for
  gamesr-footage render footage
      all of it, at 1080p, 540p and 360p; stopped and given again, it goes on where it was
  gamesr-footage render footage test --heights 1080
      the test scenes, the reference alone
  gamesr-footage split footage && gamesr-train footage/footage.toml runs/mine
      train on what was filmed

needs, on Debian: apt-get install xvfb gcc libc6-dev, and the games: see `list`.

Exit status: 0 done, 1 refused or failed (one sentence says why), 2 wrong usage, 130 interrupted.
"""


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser(PROGRAM, "Film free games frame by frame, at several resolutions from the same camera path.", EPILOG)
    parser.add_argument("--games", type=Path, default=GAMES, metavar="FOLDER", help="the game files (default: those that ship)")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    add = _adder(commands)
    listing = add("list", _list, "show games and scenes", folder=False)
    listing.add_argument("--json", action="store_true", help="a JSON line a scene")
    recording = add("record", _record, "record the demos that scenes are played from", folder=False)
    recording.add_argument("--force", action="store_true", help="record again what has a demo")
    rendering = add("render", _render, "film what is missing, and keep what moves and matches", folder=True)
    rendering.add_argument(
        "--heights",
        type=whole_number(2, 8192),
        nargs="+",
        default=list(HEIGHTS),
        help="the reference's and lower ones (default: %(default)s)",
    )
    rendering.add_argument("--jobs", type=whole_number(), default=physical_cores(), help="games at a time (default here: %(default)s)")
    rendering.add_argument("--timeout", type=float, default=1800, metavar="SECONDS", help="of one shot (default: %(default)s)")
    checking = add("check", _check, "measure again what is there: hashes, motion, alignment", folder=True)
    checking.add_argument("--again", action="store_true", help="film the smallest size once more: are the frames the same, to the bit?")
    add("split", _split, "write FOLDER/footage.toml, the list that gamesr-train reads", folder=True)
    arguments = parser.parse_args(argv)

    def work() -> int:
        return int(arguments.work(choose(load_games(arguments.games), arguments.what), arguments))

    return run_command(PROGRAM, work, debug=arguments.debug, interrupted="stopped; the same command goes on from here")


def _adder(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> Callable[..., argparse.ArgumentParser]:
    def add(name: str, work: Callable[[list[SceneSpec], argparse.Namespace], int], about: str, *, folder: bool) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=about, description=about[0].upper() + about[1:] + ".")
        if folder:
            parser.add_argument("folder", type=Path, help="where the footage is")
        parser.add_argument("what", nargs="*", metavar="WHAT", help="a game, a scene (GAME/SCENE) or a split")
        parser.set_defaults(work=work)
        return parser

    return add


def _list(scenes: list[SceneSpec], arguments: argparse.Namespace) -> int:
    if arguments.json:
        for scene in scenes:
            facts = {"scene": scene.title, "split": scene.split, "frames": scene.frames, "fps": scene.game.fps, "native": scene.native}
            print(json.dumps({**facts, "antialiased": scene.antialiased, "packages": scene.game.packages, "licence": scene.game.licence}))
        return 0
    for name, of_game in itertools.groupby(scenes, lambda scene: scene.game.name):
        chosen = list(of_game)
        game = chosen[0].game
        print(f"{name} ({game.title}): apt-get install {' '.join(game.packages)}; {game.fps} fps; {game.licence}")
        for scene in chosen:
            notes = ["anti-aliased too"] if scene.antialiased else []
            notes += [] if scene.native else ["reference only"]
            notes += ["no demo yet"] if scene.demo is not None and not scene.demo.is_file() else []
            print(f"  {scene.title:32} {scene.split:9} {scene.frames:4} frames  {', '.join(notes)}".rstrip())
    totals = {split: [scene.frames for scene in scenes if scene.split == split] for split in SPLITS}
    print("; ".join(f"{split}: {len(frames)} scenes, {sum(frames)} frames" for split, frames in totals.items()))
    return 0


def _record(scenes: list[SceneSpec], arguments: argparse.Namespace) -> int:
    todo = [scene for scene in scenes if scene.demo is not None and (arguments.force or not scene.demo.is_file())]
    if not todo:
        print("every demo is there", file=sys.stderr)
        return 0
    clock = build_frame_clock(CLOCKS)
    with hidden_display(*WINDOW) as display:
        for scene in tqdm(todo, unit="demo", disable=not sys.stderr.isatty()):
            print(record(scene, clock=clock, display=display, timeout_s=600))
    return 0


def _render(scenes: list[SceneSpec], arguments: argparse.Namespace) -> int:
    heights = sorted(set(arguments.heights), reverse=True)
    if heights[-1] < 36 or heights[0] > 2160 or any(heights[0] % height or height * 16 % 9 or height % 2 for height in heights):
        raise InputError(
            f"heights {heights} do not fit: each an even number from 36 to 2160 that 9 divides, the greatest a multiple of the others"
        )
    library = Library(arguments.folder)
    total = sum(scene.frames * len(library.missing(scene, shots_of(scene, heights))) for scene in scenes)
    failed = 0
    with tqdm(total=total, unit="frame", disable=not sys.stderr.isatty()) as bar:
        for event in render(scenes, library, heights, jobs=arguments.jobs, timeout_s=arguments.timeout):
            if isinstance(event, FramesDone):
                bar.update(event.frames)
                continue
            with bar.external_write_mode(file=sys.stdout):
                if isinstance(event, SceneDone):
                    print(f"{event.scene.title}: {event.entry.verdict()}", flush=True)
                else:
                    failed += 1
                    print(f"{event.scene.title}: failed: {event.reason}", flush=True)
    _summary(scenes, library)
    return 1 if failed else 0


def _check(scenes: list[SceneSpec], arguments: argparse.Namespace) -> int:
    library = Library(arguments.folder)
    there = [scene for scene in scenes if library.entry(scene) is not None]
    if not there:
        raise InputError(f"{arguments.folder} holds none of these scenes")
    bad = 0
    for scene in tqdm(there, unit="scene", disable=not sys.stderr.isatty()):
        damage = library.damage(scene)
        if damage is None and library.kept(scene):
            damage = library.judge(scene).objection()
        if damage is None and arguments.again and library.kept(scene):
            damage = _film_again(scene, library)
        bad += damage is not None
        tqdm.write(f"{scene.title}: {damage or library.require(scene).verdict()}", file=sys.stdout)
    return 1 if bad else 0


def _film_again(scene: SceneSpec, library: Library) -> str | None:
    name, filmed = library.smallest(scene)
    with hidden_display(*WINDOW) as display:
        frames = film(scene, Shot(int(name.rstrip("p"))), clock=build_frame_clock(CLOCKS), display=display, timeout_s=1800)
        same = frames_digest(frames) == filmed.frames_sha256
    if same or not scene.game.repeatable:
        return None
    return f"a second render at {name} has other frames"


def _split(scenes: list[SceneSpec], arguments: argparse.Namespace) -> int:
    library = Library(arguments.folder)
    path = library.write_footage_list(scenes)
    _summary(scenes, library)
    print(path)
    return 0


def _summary(scenes: list[SceneSpec], library: Library) -> None:
    kept = [scene for scene in scenes if library.kept(scene)]
    for split in SPLITS:
        chosen = [scene for scene in kept if scene.split == split]
        print(f"{split}: {len(chosen)} scenes, {sum(scene.frames for scene in chosen)} frames")
