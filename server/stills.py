"""The frame viewer's pictures: each one computed once, one at a time, and kept while there is room."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
from collections import OrderedDict
from pathlib import Path

from client.errors import GamesrError
from client.measurement import in_fresh_process
from client.whole_file import write_whole
from server.still import Still, render

_KEPT_FAILURES = 256
_LOG = logging.getLogger(__name__)


class StillsBusyError(Exception):
    """As many pictures wait to be computed as may."""


class Stills:
    """Pictures in a folder, at most `kept_bytes` of them: those go first that nobody has looked at for longest."""

    def __init__(self, folder: Path, *, most: int, kept_bytes: int) -> None:
        self._folder, self._most, self._kept_bytes = folder, most, kept_bytes
        self._lock = threading.Lock()
        self._wanted: dict[str, Still] = {}  # by key, in the order in which they were asked for
        self._failed: OrderedDict[str, str] = OrderedDict()
        self._todo: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._work, daemon=True).start()

    def find(self, still: Still) -> bytes | None:
        """The PNG, or None while it is computed, which this begins; raises StillsBusyError, and GamesrError where it failed."""
        key = still.key
        with contextlib.suppress(FileNotFoundError):
            path = self._path(key)
            content = path.read_bytes()
            os.utime(path)
            return content
        with self._lock:
            if key in self._failed:
                raise GamesrError(self._failed.pop(key))
            if key not in self._wanted:
                if len(self._wanted) >= self._most:
                    raise StillsBusyError
                self._wanted[key] = still
                self._todo.put(key)
        return None

    def waiting(self) -> int:
        return len(self._wanted)

    def _work(self) -> None:
        while True:
            key = self._todo.get()
            still = self._wanted[key]
            reason = None
            try:
                write_whole(self._path(key), in_fresh_process(render, still, "the process that computed this frame"))
                self._make_room()
            except GamesrError as error:
                reason = str(error).replace(str(still.clip), "the clip")
            except Exception:
                _LOG.exception("frame %s", key)
                reason = "an error of the service ended it: see its log"
            with self._lock:
                del self._wanted[key]
                if reason is not None:
                    self._failed[key] = reason
                    while len(self._failed) > _KEPT_FAILURES:
                        self._failed.popitem(last=False)

    def _make_room(self) -> None:
        files = sorted((path.stat().st_mtime_ns, path.stat().st_size, path) for path in self._folder.glob("*.png"))
        total = sum(size for _, size, _ in files)
        for _, size, path in files[:-1]:
            if total <= self._kept_bytes:
                break
            path.unlink(missing_ok=True)
            total -= size

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.png"
