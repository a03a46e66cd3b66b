"""Game footage for training: scenes split by map or track, degraded as a cloud server degrades them, cut into clips.

A footage list is a TOML file; paths are relative to it:

    [[scene]]
    name = "oa_koth1"                       # a map or track; the split is by scene, never by frame
    game = "openarena"
    split = "train"                         # train | validate | test
    fps = 60
    reference = "oa_koth1_1080p.mkv"        # the high-resolution picture
    native = { 540 = "oa_koth1_540p.mkv" }  # optional: the same frames rendered at lower heights
    antialiased = "oa_koth1_1080p_aa.mkv"   # optional: the reference's frames, supersampled

gamesr-footage makes such a list, and the footage.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.cloud import CloudSettings, area_downscale, through_codec
from client.errors import InputError
from client.frames import Frame
from client.video import VideoSource
from client.whole_frames import whole_frames

CACHE_VERSION = 1
CROP_CANDIDATES = 8
MAX_FPS = 1000


@dataclass(frozen=True)
class Scene:
    """One continuous take of one map or track."""

    name: str
    game: str
    split: str
    fps: int
    reference: Path
    native: dict[int, Path] = field(default_factory=dict)
    antialiased: Path | None = None

    @property
    def title(self) -> str:
        return f"{self.game}/{self.name}"


def load_scenes(footage: Path, *, split: str, games: Iterable[str] = ()) -> list[Scene]:
    """The scenes of one split, of the given games or of all; raises InputError when the list is unreadable or nothing is left."""
    try:
        rows = tomllib.loads(footage.read_text())["scene"]
        scenes = [_scene(row, footage.parent) for row in rows]
    except OSError as error:
        raise InputError(f"{footage} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{footage} is not a footage list: {error}") from error
    by_name: dict[str, str] = {}
    for scene in scenes:
        if by_name.setdefault(scene.title, scene.split) != scene.split:
            raise InputError(f"{footage}: {scene.title} is in two splits; a map or track belongs to one")
    wanted = set(games) or {scene.game for scene in scenes}
    chosen = [scene for scene in scenes if scene.split == split and scene.game in wanted]
    if not chosen:
        raise InputError(f"{footage} has no {split} scene of {', '.join(sorted(wanted))}")
    return chosen


def _scene(row: Mapping[str, object], folder: Path) -> Scene:
    """A table of the list; raises what a table of another form leads to."""
    name, game, split, reference = (_text(row[key]) for key in ("name", "game", "split", "reference"))
    if len(f"{game}/{name}".split()) != 1:
        raise ValueError(f"{game}/{name} has a space in it")  # rows of figures are told apart by title and degradation
    fps, native = row["fps"], row.get("native", {})
    if type(fps) is not int or not 1 <= fps <= MAX_FPS:
        raise ValueError(f"fps is a whole number from 1 to {MAX_FPS}, not {fps!r}")
    if not isinstance(native, dict):
        raise TypeError(f"native has files by height, and is not {native!r}")
    renders = {int(height): folder / _text(path) for height, path in native.items()}
    antialiased = folder / _text(row["antialiased"]) if "antialiased" in row else None
    return Scene(name, game, split, fps, folder / reference, renders, antialiased)


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value


@dataclass(frozen=True)
class Degradation:
    """How the low-resolution picture comes about, and what it is to become again.

    Written `area` (averaged down), `native` (rendered small: aliased), `native:aa` (the same, held against the anti-aliased
    reference), each also encoded: `area@4000` at 4000 kbps.
    """

    source: str
    bitrate_kbps: int | None = None
    antialiased: bool = False

    @classmethod
    def parse(cls, text: str) -> Degradation:
        found = re.fullmatch("(area|native)(:aa)?(?:@0*([1-9][0-9]{0,5}))?", text)
        if not found:
            raise InputError(f"{text!r} is not a degradation: write area, native, area:aa or native:aa, and @4000 behind it for 4000 kbps")
        source, antialiased, bitrate = found.groups()
        return cls(source, int(bitrate) if bitrate else None, bool(antialiased))

    def __str__(self) -> str:
        return self.source + (":aa" if self.antialiased else "") + (f"@{self.bitrate_kbps}" if self.bitrate_kbps else "")

    def fits(self, scene: Scene) -> bool:
        """Has the scene been rendered in the ways that this needs, at some height?"""
        return (self.source != "native" or bool(scene.native)) and (not self.antialiased or scene.antialiased is not None)


@dataclass(frozen=True)
class Take:
    """Decoded frames in a memory-mapped array: uint8 (frames, 3*H/2, W), each frame as I420.

    `digest` is of all that they come from: the films' contents, the scale and the encoder's settings.
    """

    data: NDArray[np.uint8]
    digest: str

    def __len__(self) -> int:
        return len(self.data)

    @property
    def height(self) -> int:
        return int(self.data.shape[1]) * 2 // 3

    @property
    def width(self) -> int:
        return int(self.data.shape[2])

    def planes(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
        """Views y (frames, H, W) and u, v (frames, H/2, W/2)."""
        frames, _, width = self.data.shape
        luma, chroma = self.data[:, : self.height], self.data[:, self.height :].reshape(frames, 2, self.height // 2, width // 2)
        return luma, chroma[:, 0], chroma[:, 1]

    def frame(self, index: int) -> Frame:
        y, u, v = self.planes()
        return Frame(y[index], u[index], v[index])


class FootageCache:
    """Decodes and degrades every scene once, or its first `frames`, into a folder that may be deleted at any time."""

    def __init__(self, folder: Path, frames: int | None = None) -> None:
        self.folder, self.frames = folder, frames
        folder.mkdir(parents=True, exist_ok=True)

    def reference(self, scene: Scene, *, antialiased: bool = False) -> Take:
        """The scene as it should become; raises InputError when an anti-aliased one is wanted and there is none."""
        path = _target(scene, antialiased)
        return self._take({"file": _digest(path)}, lambda: _film(path))

    def degraded(self, scene: Scene, scale: int, degradation: Degradation) -> Take:
        """The scene at 1/scale; raises InputError when a native render is wanted and there is none of that size."""
        reference = self.reference(scene, antialiased=degradation.antialiased)
        digest = _digest(_target(scene, degradation.antialiased))
        key: dict[str, object] = {"file": digest, "scale": scale, "source": degradation.source}
        if degradation.source == "native":
            height = reference.height // scale
            if height not in scene.native:
                raise InputError(f"{scene.title} has no native {height}p render")
            key["native"] = _digest(scene.native[height])
        settings = None
        if degradation.bitrate_kbps:
            settings = CloudSettings(degradation.bitrate_kbps, scene.fps)
            key["encoder"] = settings.record()

        def frames() -> Iterator[Frame]:
            if degradation.source == "native":
                small: Iterator[Frame] = islice(_film(scene.native[reference.height // scale]), len(reference))
            else:
                small = (area_downscale(reference.frame(i), scale) for i in range(len(reference)))
            return small if settings is None else through_codec(small, settings)

        return self._take(key, frames)

    def _take(self, key: dict[str, object], frames: Callable[[], Iterable[Frame]]) -> Take:
        if self.frames is not None:
            key["frames"] = self.frames
        digest = hashlib.sha256(json.dumps([CACHE_VERSION, key], sort_keys=True).encode()).hexdigest()[:24]
        path = self.folder / f"{digest}.npy"
        if not path.exists():
            rows = [
                np.concatenate([plane.reshape(-1) for plane in (f.y, f.u, f.v)]).reshape(-1, f.width) for f in islice(frames(), self.frames)
            ]
            if not rows:
                raise InputError(f"no frames: {key}")
            partial = path.with_suffix(f".{os.getpid()}.npy")
            try:
                np.save(partial, np.stack(rows))
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        return Take(np.load(path, mmap_mode="c"), digest)  # torch warns of arrays that it could not write to


def _film(path: Path) -> Iterator[Frame]:
    with VideoSource(path) as source:
        yield from whole_frames(source)


def _target(scene: Scene, antialiased: bool) -> Path:
    path = scene.antialiased if antialiased else scene.reference
    if path is None:
        raise InputError(f"{scene.title} has no anti-aliased reference")
    return path


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error


@dataclass(frozen=True)
class Pair:
    """A low-resolution take and the reference that it came from, frame for frame."""

    title: str
    low: Take
    high: Take

    def __len__(self) -> int:
        return min(len(self.low), len(self.high))


def load_pairs(scenes: Iterable[Scene], cache: FootageCache, scale: int, degradations: Iterable[Degradation]) -> list[list[Pair]]:
    """For each scene its degraded takes, those left out for which it was not rendered."""
    wanted = list(degradations)
    pairs = []
    for scene in scenes:
        takes = [d for d in wanted if d.fits(scene)]
        pairs.append(
            [Pair(f"{scene.title} {d}", cache.degraded(scene, scale, d), cache.reference(scene, antialiased=d.antialiased)) for d in takes]
        )
    return [takes for takes in pairs if takes]


def by_game(pairs: list[list[Pair]]) -> list[list[list[Pair]]]:
    """Scenes grouped by game, so that each game is drawn as often however many scenes it has."""
    games: dict[str, list[list[Pair]]] = {}
    for takes in pairs:
        games.setdefault(takes[0].title.split("/")[0], []).append(takes)
    return list(games.values())


def sample_clips(
    games: list[list[list[Pair]]], *, seed: int, index: int, batch: int, frames: int, patch: int, scale: int
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
    """Batch number `index` of a run: random crops of random clips of `by_game`, a pure function of its arguments.

    Each crop is the one with the most fine detail of a few random ones: in flat areas there is nothing to learn (after 360
    steps +0.71 dB over bicubic on a held-out map, where uniform crops reached +0.35). Nothing is mirrored: left-sited chroma
    would become right-sited, and no game is played in a mirror.

    Gives low and high planes [y, u, v], uint8 (batch, frames, 1, patch, patch) for low luma, `scale` times that for high.
    """
    rng = np.random.default_rng([seed, index])
    low: list[list[NDArray[np.uint8]]] = [[], [], []]
    high: list[list[NDArray[np.uint8]]] = [[], [], []]
    for _ in range(batch):
        scenes = games[rng.integers(len(games))]
        takes = scenes[rng.integers(len(scenes))]
        pair = takes[rng.integers(len(takes))]
        first = int(rng.integers(len(pair) - frames + 1))
        top, left = _busiest_crop(pair.low.planes()[0][first], patch, rng)
        for planes, take, factor in ((low, pair.low, 1), (high, pair.high, scale)):
            for out, plane, sub in zip(planes, take.planes(), (1, 2, 2), strict=True):
                y, x, side = top * factor // sub, left * factor // sub, patch * factor // sub
                out.append(plane[first : first + frames, y : y + side, x : x + side])
    return [np.stack(p)[:, :, None] for p in low], [np.stack(p)[:, :, None] for p in high]


def _busiest_crop(luma: NDArray[np.uint8], patch: int, rng: np.random.Generator) -> tuple[int, int]:
    """Top and left, both even, of the one of `CROP_CANDIDATES` random crops whose second differences are largest."""
    height, width = luma.shape
    crops = []
    for _ in range(CROP_CANDIDATES):
        top, left = (2 * int(rng.integers((side - patch) // 2 + 1)) for side in (height, width))
        crop = luma[top : top + patch, left : left + patch].astype(np.int16)
        detail = np.abs(np.diff(crop, 2, 0)).mean() + np.abs(np.diff(crop, 2, 1)).mean()
        crops.append((float(detail), top, left))
    _, top, left = max(crops)
    return top, left
