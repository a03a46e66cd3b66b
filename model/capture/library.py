"""A folder of filmed scenes: the files, and a manifest of what each is and how it was found."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import threading
import time
from collections.abc import Generator, Iterable
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av

from client.errors import GamesrError, InputError
from client.frames import BT709_LIMITED, Frame
from client.video import to_av_frame
from model.capture.checking import Alignment, Liveliness, alignment, liveliness
from model.capture.filming import Shot, film
from model.capture.games import SceneSpec

MANIFEST = "manifest.json"
X264_OPTIONS = {"preset": "faster", "crf": "12", "threads": "1"}  # visually lossless; one thread, for one file whatever the machine


@dataclass
class Filmed:
    """One file: where it is (relative to the folder), its frames' hash (of the game's own I420, before the encoder) and its own."""

    path: str
    frames: int
    frames_sha256: str
    sha256: str
    seconds: float


@dataclass
class Entry:
    """What is known of one scene: its files by shot, and what was measured; `rejected` and `misaligned` hold the reasons."""

    digest: str
    licence: str
    files: dict[str, Filmed] = field(default_factory=dict)
    liveliness: Liveliness | None = None
    alignment: dict[str, Alignment] = field(default_factory=dict)
    rejected: str | None = None
    misaligned: dict[str, str] = field(default_factory=dict)

    def kept_files(self) -> list[str]:
        """The shots that are kept, the reference first."""
        return sorted((name for name in self.files if name not in self.misaligned), key=_rank)

    def objection(self) -> str | None:
        """Why something of the scene was thrown away, or None."""
        reasons = [self.rejected] if self.rejected else [f"{name}: {reason}" for name, reason in self.misaligned.items()]
        return "; ".join(reasons) or None

    def verdict(self) -> str:
        """What became of the scene, in a line."""
        if self.rejected:
            return f"thrown away: {self.rejected}"
        change = sum(self.liveliness.changes) / len(self.liveliness.changes) if self.liveliness else 0.0
        margins = [f"{name} aligned by {found.margin_db:.1f} dB" for name, found in self.alignment.items() if name not in self.misaligned]
        lost = [f"{name} thrown away: {reason}" for name, reason in self.misaligned.items()]
        return "; ".join([f"kept, {change:.1f} code values of change a frame", *margins, *lost])


class Library:
    """The scenes in one folder; the manifest is written whole after every change, by several threads and processes if need be."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._entries = _read(folder / MANIFEST)
        self._lock = threading.Lock()

    def entry(self, scene: SceneSpec) -> Entry | None:
        """What is known of the scene as its game's file describes it now; None where that has changed since, or it was never filmed."""
        entry = self._entries.get(scene.title)
        return entry if entry is not None and entry.digest == scene.digest() else None

    def missing(self, scene: SceneSpec, shots: list[Shot]) -> list[Shot]:
        """What is still to be filmed of a scene; nothing of one that was thrown away."""
        entry = self.entry(scene)
        if entry is None:
            return shots
        return [] if entry.rejected else [shot for shot in shots if not self._is_there(entry, shot)]

    def is_unmeasured(self, scene: SceneSpec) -> bool:
        """Was the scene filmed, but not measured since (stopped in between)?"""
        entry = self.entry(scene)
        return entry is not None and entry.liveliness is None

    def put(self, scene: SceneSpec, shot: Shot, filmed: Filmed) -> None:
        """Remember a file that was filmed."""
        entry = self.entry(scene) or Entry(scene.digest(), scene.game.licence)
        entry.files[shot.name] = filmed
        entry.liveliness = None
        entry.misaligned.pop(shot.name, None)
        self._save(scene, entry)

    def judge(self, scene: SceneSpec) -> Entry:
        """Measure a filmed scene; throw its files away where it is still or empty, and single sizes that do not match the reference."""
        entry = self.require(scene)
        reference, *others = entry.kept_files()
        entry.liveliness = liveliness(self.folder / entry.files[reference].path, scene.game.fps)
        entry.rejected = entry.liveliness.objection()
        for name in others if entry.rejected is None else ():
            found = alignment(self.folder / entry.files[reference].path, self.folder / entry.files[name].path, scene.game.world)
            entry.alignment[name] = found
            objection = found.objection()
            if objection is not None:
                entry.misaligned[name] = objection
        for name in entry.files if entry.rejected else entry.misaligned:
            (self.folder / entry.files[name].path).unlink(missing_ok=True)
        self._save(scene, entry)
        return entry

    def require(self, scene: SceneSpec) -> Entry:
        """`entry`, of a scene that was filmed; raises InputError for another."""
        entry = self.entry(scene)
        if entry is None:
            raise InputError(f"{scene.title} is not in {self.folder}, or its game's file has changed since: gamesr-footage render films it")
        return entry

    def kept(self, scene: SceneSpec) -> bool:
        """Was the scene filmed, measured and not thrown away?"""
        entry = self.entry(scene)
        return entry is not None and entry.liveliness is not None and entry.rejected is None

    def damage(self, scene: SceneSpec) -> str | None:
        """Which file of a scene is not what the manifest says, or None."""
        entry = self.require(scene)
        for name in entry.kept_files() if entry.rejected is None else ():
            path = self.folder / entry.files[name].path
            if not path.is_file():
                return f"{path.name} is missing"
            if _digest(path) != entry.files[name].sha256:
                return f"{path.name} is not the file that was filmed"
        return None

    def smallest(self, scene: SceneSpec) -> tuple[str, Filmed]:
        """The shot that costs least to film again: its name and what is known of it."""
        entry = self.require(scene)
        name = min((name for name in entry.files if name.endswith("p")), key=lambda name: int(name.rstrip("p")))
        return name, entry.files[name]

    def write_footage_list(self, scenes: Iterable[SceneSpec]) -> Path:
        """The kept ones among `scenes` as a list for gamesr-train (see model.footage), paths relative to it.

        Raises InputError if there are none.
        """
        blocks = []
        for scene in scenes:
            if not self.kept(scene):
                continue
            names = self.require(scene).kept_files()
            paths = {name: self.require(scene).files[name].path for name in names}
            lines = [
                "[[scene]]",
                f'name = "{scene.name}"',
                f'game = "{scene.game.name}"',
                f'split = "{scene.split}"',
                f"fps = {scene.game.fps}",
            ]
            lines.append(f'reference = "{paths[names[0]]}"')
            native = ", ".join(f'{name.rstrip("p")} = "{paths[name]}"' for name in names[1:] if name.endswith("p"))
            lines += [f"native = {{ {native} }}"] if native else []
            lines += [f'antialiased = "{paths[name]}"' for name in names if name.endswith("_aa")]
            blocks.append("\n".join(lines) + "\n")
        if not blocks:
            raise InputError(f"{self.folder} holds none of these scenes")
        path = self.folder / "footage.toml"
        partial = path.with_suffix(f".{os.getpid()}.part")
        partial.write_text("\n".join(blocks))
        partial.replace(path)
        return path

    def _save(self, scene: SceneSpec, entry: Entry) -> None:
        """Write the manifest with this entry in it, whole or not at all; what others have added meanwhile stays."""
        with self._lock, (self.folder / f".{MANIFEST}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self._entries = _read(self.folder / MANIFEST) | {scene.title: entry}
            partial = self.folder / f".{MANIFEST}.part"
            partial.write_text(json.dumps({title: asdict(self._entries[title]) for title in sorted(self._entries)}, indent=1) + "\n")
            partial.replace(self.folder / MANIFEST)

    def _is_there(self, entry: Entry, shot: Shot) -> bool:
        filmed = entry.files.get(shot.name)
        return filmed is not None and (shot.name in entry.misaligned or (self.folder / filmed.path).is_file())


def film_to_file(scene: SceneSpec, shot: Shot, folder: Path, *, clock: Path, display: str, timeout_s: float) -> Generator[Frame | Filmed]:
    """Film a shot into `folder`, each frame given once it is encoded, the file that came of it last; raises what `film` raises."""
    path = Path(scene.game.name) / f"{scene.name}_{shot.name}.mkv"
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    partial = folder / path.parent / f".{path.name}.{os.getpid()}.part"
    begin = time.monotonic()
    raw = _FramesHash()
    try:
        with (
            contextlib.closing(film(scene, shot, clock=clock, display=display, timeout_s=timeout_s)) as frames,
            _Encoder(partial, shot, scene) as encoder,
        ):
            for frame in frames:
                raw.add(frame)
                encoder.write(frame)
                yield frame
        partial.replace(folder / path)
    except OSError as error:
        raise GamesrError(f"cannot write {folder / path}: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
    yield Filmed(str(path), scene.frames, raw.hexdigest(), _digest(folder / path), round(time.monotonic() - begin, 1))


def frames_digest(frames: Iterable[Frame]) -> str:
    """The hash of a shot's frames, as the manifest holds it."""
    total = _FramesHash()
    for frame in frames:
        total.add(frame)
    return total.hexdigest()


class _FramesHash:
    def __init__(self) -> None:
        self._sha256 = hashlib.sha256()

    def add(self, frame: Frame) -> None:
        for plane in (frame.y, frame.u, frame.v):
            self._sha256.update(plane.data)

    def hexdigest(self) -> str:
        return self._sha256.hexdigest()


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class _Encoder:
    def __init__(self, path: Path, shot: Shot, scene: SceneSpec) -> None:
        self._container = av.open(str(path), "w", format="matroska", options={"fflags": "+bitexact"})  # no random identifiers
        self._stream = self._container.add_stream("libx264", rate=Fraction(scene.game.fps), options=dict(X264_OPTIONS))
        context = self._stream.codec_context
        context.width, context.height, context.pix_fmt = shot.width, shot.height, "yuv420p"
        context.time_base = Fraction(1, scene.game.fps)
        context.color_range, context.colorspace = BT709_LIMITED.range, BT709_LIMITED.matrix
        context.color_primaries, context.color_trc = BT709_LIMITED.primaries, BT709_LIMITED.transfer

    def __enter__(self) -> _Encoder:
        return self

    def write(self, frame: Frame) -> None:
        self._container.mux(self._stream.encode(to_av_frame(frame)))

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is None:
            self._container.mux(self._stream.encode(None))
        self._container.close()


def _rank(name: str) -> tuple[bool, int]:
    """The reference first: the highest picture that is not averaged."""
    height, _, suffix = name.partition("p")
    return bool(suffix), -int(height)


def _read(path: Path) -> dict[str, Entry]:
    try:
        table: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is not a manifest of footage: {error}") from error
    return {title: _entry(row) for title, row in table.items()}


def _entry(row: dict[str, Any]) -> Entry:
    return Entry(
        digest=row["digest"],
        licence=row["licence"],
        files={name: Filmed(**values) for name, values in row["files"].items()},
        liveliness=Liveliness(tuple(row["liveliness"]["changes"]), row["liveliness"]["detail"]) if row["liveliness"] else None,
        alignment={name: Alignment(**{**values, "psnr_db": tuple(values["psnr_db"])}) for name, values in row["alignment"].items()},
        rejected=row["rejected"],
        misaligned=row["misaligned"],
    )
