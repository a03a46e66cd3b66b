"""Clips by name: those of the folder that the service was given, and those that were uploaded."""

from __future__ import annotations

import contextlib
import json
import logging
import mimetypes
import os
import re
import secrets
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from client.errors import InputError, OutputError
from server.clips import SCALES
from server.database import Database
from server.names import shown
from server.probe import Known, probe
from server.requests import NAME, StoredClip
from server.settings import Settings

UPLOADED = "upload-"
SUFFIXES = (".mp4", ".mkv", ".mov", ".webm", ".ts", ".avi", ".h264", ".ivf", ".y4m")  # of a folder's clips
_LOOK_S = 5.0
_LOG = logging.getLogger(__name__)
_LOOKED_AT = threading.Lock()  # one process looks at a clip at a time


class Library:
    """A clip's name is looked up among the files that are there; no path is ever made of what a caller sent.

    Of the folder, videos of other suffixes, names that are no names, and links are refused; what is no video, is hidden, or lies in
    folders below it is not seen. What is found out about a file is remembered for as long as its size and time stay the same.
    """

    def __init__(self, database: Database, settings: Settings) -> None:
        self._database, self._settings = database, settings
        self._looked = threading.Event()
        self._looked.set()

    def look_at_all(self) -> None:
        """Begin to look at the clips of the folder, so that sweeps find theirs among them."""
        self._looked.clear()
        threading.Thread(target=self._look_at_all, daemon=True).start()

    def clips(self) -> tuple[list[StoredClip], dict[str, str]]:
        """Every clip, and the files of the folder that cannot be used with the reason why."""
        found = []
        files, refused = self._sorted_out()
        for name, path in sorted(files.items()):
            try:
                clip = self._clip(name, path)
            except InputError as error:
                refused[name] = str(error)
            else:
                found += [clip] if clip else []
        return found, refused

    def clip(self, name: str) -> StoredClip | None:
        """None where there is no such clip; raises InputError for a file of the folder that cannot be used."""
        path = self.path(name)
        return None if path is None else self._clip(name, path)

    def path(self, name: str) -> Path | None:
        return self._files().get(name)

    def known_names(self) -> dict[str, str]:
        """By sha256, the clips that have been looked at, uploads before the folder's; waits a moment for those that are being looked at."""
        self._looked.wait(_LOOK_S)
        there = {}
        for name, path in self._files().items():
            with contextlib.suppress(OSError):
                there[name] = _stamp(path.stat())
        rows = self._database.rows("SELECT name, stamp, known FROM clips WHERE known IS NOT NULL")
        rows.sort(key=lambda row: str(row[0]).startswith(UPLOADED))
        return {str(json.loads(known)["sha256"]): str(name) for name, stamp, known in rows if there.get(name) == stamp}

    def uploads(self) -> int:
        return sum(name.startswith(UPLOADED) for name in self._files())

    def take_in(self, uploaded: Path, suffix: str, title: str) -> StoredClip:
        """Look at an uploaded file and keep it under a name of ours; raises InputError for what is no usable clip.

        The same clip a second time is the first one again. The file is moved or left to the caller to remove.
        """
        with _LOOKED_AT:
            known = probe(uploaded, self._settings.limits, whole=True)
        name = self.known_names().get(known.sha256)
        if name is None or not name.startswith(UPLOADED):
            name = f"{UPLOADED}{secrets.token_hex(8)}{suffix}"
            path = self._settings.uploads / name
            uploaded.rename(path)
            self._remember(name, _stamp(path.stat()), title or name, known, None)
        clip = self.clip(name)
        if clip is None:
            raise OutputError(f"{name} went away while it was kept")
        return clip

    def remove(self, name: str) -> None:
        """Forget an upload and delete its file."""
        path = self.path(name)
        if path is not None and name.startswith(UPLOADED):
            path.unlink(missing_ok=True)
            with self._database.transaction() as connection:
                connection.execute("DELETE FROM clips WHERE name = ?", (name,))

    def _clip(self, name: str, path: Path) -> StoredClip | None:
        try:
            status = path.stat()
        except OSError:
            return None
        stamp = _stamp(status)
        row = self._row(name, stamp)
        if row is None:
            with _LOOKED_AT:
                row = self._row(name, stamp) or self._look_at(name, path, stamp)
        title, known, refused = row
        if known is None:
            raise InputError(str(refused))
        return _stored(name, title, status.st_size, Known(**json.loads(known)))

    def _look_at_all(self) -> None:
        try:
            self.clips()
        except OutputError as error:
            _LOG.error("%s", error)
        finally:
            self._looked.set()

    def _files(self) -> dict[str, Path]:
        return self._sorted_out()[0]

    def _sorted_out(self) -> tuple[dict[str, Path], dict[str, str]]:
        """The files that may be clips, and the videos of the folder that may not with the reason why."""
        files = {path.name: path for path in _entries(self._settings.uploads) if path.name.startswith(UPLOADED)}
        refused = {}
        for path in _entries(self._settings.clips):
            reason = _unfit(path)
            if reason is None:
                files[path.name] = path
            elif _is_video(path):
                refused[shown(path.name)] = reason
        return files, refused

    def _row(self, name: str, stamp: str) -> tuple[str, str | None, str | None] | None:
        rows = self._database.rows("SELECT title, known, refused FROM clips WHERE name = ? AND stamp = ?", name, stamp)
        return (rows[0][0], rows[0][1], rows[0][2]) if rows else None

    def _look_at(self, name: str, path: Path, stamp: str) -> tuple[str, str | None, str | None]:
        """Not whole: the folder's clips are the operator's own, and may be long."""
        try:
            known = probe(path, self._settings.limits, whole=False)
        except InputError as error:
            return self._remember(name, stamp, name, None, str(error))
        return self._remember(name, stamp, name, known, None)

    def _remember(self, name: str, stamp: str, title: str, known: Known | None, refused: str | None) -> tuple[str, str | None, str | None]:
        row = title, None if known is None else json.dumps(asdict(known)), refused
        with self._database.transaction() as connection:
            connection.execute(
                "INSERT OR REPLACE INTO clips (name, stamp, title, known, refused) VALUES (?, ?, ?, ?, ?)", (name, stamp, *row)
            )
        return row


def low_heights(width: int, height: int) -> list[int]:
    """The whole, half and third of a height that 4:2:0 can hold at that scale."""
    return [height // scale for scale in (1, *SCALES) if width % (2 * scale) == 0 and height % (2 * scale) == 0]


def _stamp(status: os.stat_result) -> str:
    return f"{status.st_size} {status.st_mtime_ns}"


def _entries(folder: Path | None) -> Iterator[Path]:
    """Files and links that are not hidden."""
    if folder is not None:
        with contextlib.suppress(OSError):
            for path in folder.iterdir():
                if not path.name.startswith(".") and (path.is_file() or path.is_symlink()):
                    yield path


def _is_video(path: Path) -> bool:
    """By its suffix, which is enough for saying why it is no clip."""
    kind, _ = mimetypes.guess_type(f"name{path.suffix.lower()}")
    return path.suffix.lower() in SUFFIXES or (kind or "").startswith("video/")


def _unfit(path: Path) -> str | None:
    """Why a file of the folder cannot be a clip, whatever is in it."""
    if path.suffix.lower() not in SUFFIXES:
        return f"its name does not end in one of {' '.join(SUFFIXES)}"
    if path.is_symlink():
        return "it is a link: put the file itself into the folder"
    if not re.fullmatch(NAME, path.name):
        return "its name is not of 1 to 96 of A-Z a-z 0-9 . _ -, a letter or digit first: rename it"
    if path.name.startswith(UPLOADED):
        return f"its name begins with {UPLOADED}, as those of uploads do: rename it"
    return None


def _stored(name: str, title: str, size_bytes: int, known: Known) -> StoredClip:
    return StoredClip(
        name=name,
        origin="upload" if name.startswith(UPLOADED) else "folder",
        title=title,
        size_bytes=size_bytes,
        duration_s=known.frames / known.fps,
        low_heights=low_heights(known.width, known.height),
        **asdict(known),
    )
