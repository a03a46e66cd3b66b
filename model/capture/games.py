"""What there is to film: games and their scenes, a TOML file a game.

    title = "OpenArena 0.8.8"
    fps = 60                                # of the virtual clock and of the footage
    process = "ioquake3"                    # the executable that draws
    packages = ["openarena"]                # Debian's
    licence = "GPL-2.0-or-later"
    repeatable = true                       # do two renders give the same frames, to the bit?
    native = true                           # are lower resolutions the same picture, but for aliasing? A scene may say otherwise
    world = [0.0, 0.1, 1.0, 0.8]            # left, top, right, bottom: where no HUD covers what is compared between sizes
    skip = 200                              # frames (buffer swaps) before the first that is filmed, and how many are filmed
    frames = 180
    small_windows = true                    # optional: false for a game that refuses windows smaller than 1920x1080
    pace_ms = 0                             # optional: real time a skipped frame lasts at least, where other threads load the world

    [play]                                  # how a scene is shown; [record] likewise makes its demo, where it has one
    command = ["/usr/games/openarena", "+set", "r_customwidth", "$width", "..."]
    environment = { SDL_AUDIODRIVER = "dummy" }
    files = { ".openarena/baseoa/play.cfg" = "..." }   # written into a fresh home folder first
    demo = ".openarena/baseoa/demos/$name.dm_71"       # where the scene's demo belongs

    [[scene]]                               # a map or a track; it belongs to one split
    name = "oa_koth1"
    split = "test"                          # train | validate | test
    antialiased = true                      # a supersampled reference too

A $word in a command, a file or an environment is the scene's value of that name (any key of the scene, of its game, and
$width, $height, $home; $port, a UDP port that nothing else uses, for a game that plays against a server of its own).
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

from client.errors import InputError

GAMES = Path(__file__).parent / "games"
SPLITS = ("train", "validate", "test")
HEIGHTS = (1080, 540, 360)
WORDS_OF_A_RUN = ("width", "height", "home", "port")  # known when a game starts, and no part of what is filmed


@dataclass(frozen=True)
class Run:
    """One start of a game: its command, the environment and the files of a fresh home folder, still with their $words."""

    command: tuple[str, ...]
    environment: Mapping[str, str]
    files: Mapping[str, str]
    demo: str | None


@dataclass(frozen=True)
class Game:
    """A game that can be filmed; `folder` holds its demos."""

    name: str
    title: str
    fps: int
    process: str
    packages: tuple[str, ...]
    licence: str
    repeatable: bool
    world: tuple[float, float, float, float]
    small_windows: bool
    pace_ms: int
    play: Run
    record: Run | None
    folder: Path


@dataclass(frozen=True)
class SceneSpec:
    """One scene of one game: which frames are filmed, what it is for, and the values of its $words."""

    game: Game
    name: str
    split: str
    skip: int
    frames: int
    native: bool
    antialiased: bool
    words: Mapping[str, str]

    @property
    def title(self) -> str:
        return f"{self.game.name}/{self.name}"

    @property
    def demo(self) -> Path | None:
        """The recorded demo that the scene is played from, where its game has such; it need not exist yet."""
        if self.game.play.demo is None:
            return None
        return self.game.folder / self.game.name / Path(self.fill(self.game.play.demo, {})).name

    def fill(self, text: str, more: Mapping[str, object]) -> str:
        """`text` with its $words replaced; raises InputError for one that nobody knows."""
        try:
            return Template(text).substitute({**self.words, **more})
        except (KeyError, ValueError) as error:
            raise InputError(f"{self.title}: {text!r} has a $word that is not known: {error}") from error

    def digest(self) -> str:
        """A hash of everything that decides what is filmed, the demo included, whatever the size."""
        run, size = self.game.play, {word: f"${word}" for word in WORDS_OF_A_RUN}
        parts: list[object] = [self.game.process, self.game.fps, self.skip, self.frames]
        parts += [[self.fill(word, size) for word in run.command], {k: self.fill(v, size) for k, v in run.environment.items()}]
        parts.append({self.fill(k, size): self.fill(v, size) for k, v in run.files.items()})
        if self.demo is not None and self.demo.is_file():
            parts.append(hashlib.sha256(self.demo.read_bytes()).hexdigest())
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def load_games(folder: Path = GAMES) -> list[SceneSpec]:
    """Every scene of every game file in a folder, in the files' order; raises InputError, naming the file, for what is wrong in it."""
    paths = sorted(folder.glob("*.toml"))
    if not paths:
        raise InputError(f"{folder} has no game file (NAME.toml)")
    return [scene for path in paths for scene in _load(path)]


def choose(scenes: Sequence[SceneSpec], wanted: Sequence[str]) -> list[SceneSpec]:
    """The scenes that are named: GAME, GAME/SCENE, or a split; all when nothing is; raises InputError for a name that fits none."""
    if not wanted:
        return list(scenes)
    chosen: dict[str, SceneSpec] = {}
    for word in wanted:
        found = [scene for scene in scenes if word in (scene.game.name, scene.title, scene.split)]
        if not found:
            raise InputError(f"there is no game, scene or split {word!r}; gamesr-footage list shows what there is")
        chosen |= {scene.title: scene for scene in found}
    return [scene for scene in scenes if scene.title in chosen]


def _load(path: Path) -> list[SceneSpec]:
    try:
        table = tomllib.loads(path.read_text())
        game = Game(
            name=path.stem,
            title=table["title"],
            fps=int(table["fps"]),
            process=table["process"],
            packages=tuple(table["packages"]),
            licence=table["licence"],
            repeatable=bool(table["repeatable"]),
            world=_world(table["world"]),
            small_windows=table.get("small_windows", True),
            pace_ms=int(table.get("pace_ms", 0)),
            play=_run(table["play"]),
            record=_run(table["record"]) if "record" in table else None,
            folder=path.parent,
        )
        scenes = [_scene(game, {**table, **row}) for row in table["scene"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is not a game file: {type(error).__name__} {error}") from error
    if len({scene.name for scene in scenes}) < len(scenes):
        raise InputError(f"{path} names a scene twice; a map or track belongs to one split")
    return scenes


def _run(table: dict[str, Any]) -> Run:
    return Run(tuple(table["command"]), dict(table.get("environment", {})), dict(table.get("files", {})), table.get("demo"))


def _world(sides: Sequence[float]) -> tuple[float, float, float, float]:
    left, top, right, bottom = (float(side) for side in sides)
    if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
        raise ValueError(f"world = {sides} is not left, top, right, bottom in 0..1")
    return left, top, right, bottom


def _scene(game: Game, row: dict[str, Any]) -> SceneSpec:
    if row["split"] not in SPLITS:
        raise ValueError(f"split {row['split']!r} is not one of {', '.join(SPLITS)}")
    name = row["name"]
    if not (name.isascii() and name.replace("_", "").replace("-", "").isalnum()):
        raise ValueError(f"{name!r} is not a plain name")
    words = {key: str(value) for key, value in row.items() if isinstance(value, str | int) and not isinstance(value, bool)}
    return SceneSpec(
        game, name, row["split"], int(row["skip"]), int(row["frames"]), bool(row["native"]), bool(row.get("antialiased")), words
    )
