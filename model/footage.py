"""Game footage for training: scenes split by map or track, degraded as a cloud server degrades them.

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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice, product
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from numpy.typing import NDArray

from client.cloud import CloudSettings, area_downscale, through_codec
from client.errors import InputError
from client.frames import Frame
from model.films import Film

CACHE_VERSION = 1
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

    @property
    def films(self) -> list[Path]:
        return [self.reference, *self.native.values(), *([self.antialiased] if self.antialiased else [])]


def load_scenes(footage: Path, *, split: str, games: Iterable[str] = ()) -> list[Scene]:
    """The scenes of one split, of the given games or of all; raises InputError when the list is unreadable or nothing is left."""
    try:
        rows = tomllib.loads(footage.read_text())["scene"]
        scenes = [_scene(row, footage.parent) for row in rows]
        films = [(path.resolve(), scene.split) for scene in scenes for path in scene.films]
    except OSError as error:
        raise InputError(f"{footage} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RuntimeError) as error:  # the last of what has no end: brackets, links
        raise InputError(f"{footage} is not a footage list: {error}") from error
    split_of: dict[object, str] = {}
    for what, of in [*((scene.title, scene.split) for scene in scenes), *films]:
        if split_of.setdefault(what, of) != of:
            raise InputError(f"{footage}: {what} is in two splits; a map or track, and what is filmed of it, belongs to one")
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
    """Decodes and degrades every scene once, or its first `frames`, into a folder that may be deleted at any time.

    Its films are looked at once, and raise what `Film.of` raises.
    """

    def __init__(self, folder: Path, frames: int | None = None) -> None:
        self.folder, self.frames = folder, frames
        self._films: dict[tuple[Path, int], Film] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def reference(self, scene: Scene, *, antialiased: bool = False) -> Take:
        """The scene as it should become; raises InputError when an anti-aliased one is wanted and there is none."""
        film = self._target(scene, antialiased)
        return self._take({"file": film.digest}, film.frames)

    def films(self, scene: Scene, scale: int, degradation: Degradation) -> tuple[Film, Film | None]:
        """What the scene should become, and the native render of it that is wanted, if one is.

        Raises InputError where there is none, or the two are not the same pictures in two sizes.
        """
        target = self._target(scene, degradation.antialiased)
        target.check_scale(scale)
        if degradation.source != "native":
            return target, None
        height = target.height // scale
        if height not in scene.native:
            raise InputError(f"{scene.title} has no native {height}p render")
        render = self._film(scene.native[height], scene.fps)
        target.check_render(render, scale)
        return target, render

    def degraded(self, scene: Scene, scale: int, degradation: Degradation) -> Take:
        """The scene at 1/scale, frame for frame its reference; raises InputError when that cannot be had."""
        target, render = self.films(scene, scale, degradation)
        reference = self.reference(scene, antialiased=degradation.antialiased)
        key: dict[str, object] = {"file": target.digest, "scale": scale, "source": degradation.source}
        if render:
            key["native"] = render.digest
        settings = None
        if degradation.bitrate_kbps:
            settings = CloudSettings(degradation.bitrate_kbps, scene.fps)
            key |= {"encoder": settings.record(), "av": av.__version__}  # which brings x264

        def frames() -> Iterator[Frame]:
            small = render.frames() if render else (area_downscale(reference.frame(i), scale) for i in range(len(reference)))
            try:
                yield from small if settings is None else through_codec(small, settings)
            except av.FFmpegError as error:
                raise InputError(f"{scene.title} cannot be encoded as {degradation} by {scale}: {error.strerror}") from error

        return self._take(key, frames)

    def _target(self, scene: Scene, antialiased: bool) -> Film:
        path = scene.antialiased if antialiased else scene.reference
        if path is None:
            raise InputError(f"{scene.title} has no anti-aliased reference")
        return self._film(path, scene.fps)

    def _film(self, path: Path, fps: int) -> Film:
        if (path, fps) not in self._films:
            self._films[path, fps] = Film.of(path, fps)
        return self._films[path, fps]

    def _take(self, key: dict[str, object], frames: Callable[[], Iterator[Frame]]) -> Take:
        if self.frames is not None:
            key["frames"] = self.frames
        digest = hashlib.sha256(json.dumps([CACHE_VERSION, key], sort_keys=True).encode()).hexdigest()[:24]
        path = self.folder / f"{digest}.npy"
        try:
            data = np.load(path, mmap_mode="c")  # torch warns of arrays that it could not write to
        except (FileNotFoundError, EOFError, ValueError):  # the last two of a file that was cut off
            _write(path, islice(frames(), self.frames))
            data = np.load(path, mmap_mode="c")
        return Take(data, digest)


def _write(path: Path, frames: Iterator[Frame]) -> None:
    """An .npy file of frames, written as they come: all of a film may be larger than memory."""
    first = next(frames)
    shape = first.height * 3 // 2, first.width
    partial = path.with_suffix(f".{os.getpid()}.npy")
    try:
        with partial.open("wb") as file:
            _write_header(file, 0, shape)
            count = 0
            for frame in chain([first], frames):
                file.write(b"".join(plane.tobytes() for plane in (frame.y, frame.u, frame.v)))
                count += 1
            file.seek(0)
            _write_header(file, count, shape)  # of the same length: NumPy leaves room for any count
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _write_header(file: BinaryIO, count: int, shape: tuple[int, int]) -> None:
    np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": (count, *shape)})


@dataclass(frozen=True)
class Pair:
    """A low-resolution take and the reference that it came from, frame for frame."""

    title: str
    low: Take
    high: Take

    def __len__(self) -> int:
        return min(len(self.low), len(self.high))


def check_films(scenes: Iterable[Scene], cache: FootageCache, scales: Iterable[int], degradations: Iterable[Degradation]) -> None:
    """Raises InputError where a film of the scenes does not fit, before any is decoded."""
    for scene, scale, degradation in product(scenes, scales, degradations):
        if degradation.fits(scene):
            cache.films(scene, scale, degradation)


def load_pairs(scenes: Sequence[Scene], cache: FootageCache, scale: int, degradations: Iterable[Degradation]) -> list[list[Pair]]:
    """For each scene its degraded takes, those left out for which it was not rendered."""
    wanted = list(degradations)
    check_films(scenes, cache, [scale], wanted)
    pairs = []
    for scene in scenes:
        takes = [d for d in wanted if d.fits(scene)]
        pairs.append(
            [Pair(f"{scene.title} {d}", cache.degraded(scene, scale, d), cache.reference(scene, antialiased=d.antialiased)) for d in takes]
        )
    return [takes for takes in pairs if takes]
