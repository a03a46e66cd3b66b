"""Every sweep that there is, whoever started it: those of the queue, and those that gamesr-sweep measured into the same store."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock
from typing import Any

from pydantic import BaseModel

from server.asked import AskedSweep
from server.library import Library
from server.points import LatencyResult, PointResult
from server.queue import QueuedSweep, SweepQueue, fresh_progress
from server.reading import KeptSweep, StoreReader
from server.schemas import ClipOfSweep, Progress, Sweep, SweepState

_ID_DIGITS = 16
_KEPT_ANSWERS = 256
_Stamp = tuple[tuple[int, int] | None, ...]  # time of change and size of every file that answers come from
_NOTHING = AskedSweep((), (), (), (), (), ())


class Sweeps:
    """Sweeps by their id: a random one in the queue, the beginning of its key in the store."""

    def __init__(self, reader: StoreReader, queue: SweepQueue, library: Library) -> None:
        self._reader, self._queue, self._library = reader, queue, library
        self._answers: OrderedDict[tuple[Any, ...], bytes] = OrderedDict()
        self._latest: dict[tuple[Any, ...], tuple[_Stamp, bytes]] = {}
        self._whole: set[str] = set()
        self._lock = Lock()

    def all(self) -> list[Sweep]:
        """The newest first; one that was started over HTTP is not there a second time as a sweep of the store."""
        kept, queued, sources = self._reader.sweeps(), self._queue.all(), self._library.known_names()
        mine = {sweep.plan_key for sweep in queued}
        found = [_of_queue(sweep, kept.get(sweep.plan_key or ""), sources) for sweep in queued]
        found += [self._of_store(key, sweep, sources) for key, sweep in kept.items() if key not in mine]
        return sorted(found, key=lambda sweep: sweep.created_at, reverse=True)

    def find(self, sweep: str) -> Sweep | None:
        sources = self._library.known_names()
        queued = self._queue.find(sweep)
        if queued is not None:
            return _of_queue(queued, self._kept(queued), sources)
        found = self._reader.sweep(sweep)
        return None if found is None else self._of_store(*found, sources)

    def progress(self, sweep: str) -> Progress | None:
        queued = self._queue.find(sweep)
        if queued is not None:
            return queued.progress
        found = self._reader.sweep(sweep)
        return None if found is None else self._progress(found[0], found[1].asked)

    def answer(
        self, sweep: str, build: Callable[[Sequence[PointResult], Sequence[LatencyResult]], BaseModel], *about: object
    ) -> bytes | None:
        """What `build` makes of a sweep's results, as JSON; None where there is no such sweep.

        Results only ever come, so an answer holds for as long as their number stays; `about` tells what is asked.
        """
        stamp = self._stamp()  # before anything is read: what is written meanwhile makes it an old one
        asked = self._asked(sweep)
        if asked is None:
            return None
        content = self._built(sweep, asked, build, about)
        with self._lock:
            if len(self._latest) >= _KEPT_ANSWERS:
                self._latest.clear()
            self._latest[sweep, about] = stamp, content
        return content

    def latest(self, sweep: str, *about: object) -> bytes | None:
        """The answer that was given last, None where a file of results or of the queue was written to since.

        Takes some microseconds, so that it may run on the event loop.
        """
        found = self._latest.get((sweep, about))
        return found[1] if found is not None and found[0] == self._stamp() else None

    def _stamp(self) -> _Stamp:
        files = (self._reader.path, self._queue.path)
        return tuple(_status(path) for file in files for path in (file, file.with_name(f"{file.name}-wal")))

    def _built(
        self,
        sweep: str,
        asked: AskedSweep,
        build: Callable[[Sequence[PointResult], Sequence[LatencyResult]], BaseModel],
        about: tuple[object, ...],
    ) -> bytes:
        key = (sweep, about, *self._reader.counts(asked))
        with self._lock:
            if key in self._answers:
                self._answers.move_to_end(key)
                return self._answers[key]
        content = build(self._reader.points(asked), self._reader.latencies(asked)).model_dump_json().encode()
        with self._lock:
            self._answers[key] = content
            while len(self._answers) > _KEPT_ANSWERS:
                self._answers.popitem(last=False)
        return content

    def _asked(self, sweep: str) -> AskedSweep | None:
        """Which results are this sweep's; none of them before it is planned."""
        queued = self._queue.find(sweep)
        if queued is not None:
            kept = self._kept(queued)
            return kept.asked if kept else _NOTHING
        found = self._reader.sweep(sweep)
        return found[1].asked if found else None

    def _kept(self, queued: QueuedSweep) -> KeptSweep | None:
        found = self._reader.sweep(queued.plan_key) if queued.plan_key else None
        return found[1] if found else None

    def _of_store(self, key: str, kept: KeptSweep, sources: dict[str, str]) -> Sweep:
        return Sweep(
            id=key[:_ID_DIGITS],
            origin="command",
            created_at=kept.created_at,
            clips=_clips(kept.asked, sources),
            upscalers=list(kept.asked.upscalers),
            low_heights=list(kept.asked.low_heights),
            bitrates_kbps=list(kept.asked.bitrates_kbps),
            progress=self._progress(key, kept.asked),
            failures=[],
        )

    def _progress(self, key: str, asked: AskedSweep) -> Progress:
        """As far as the store shows; what failed is known to the command only."""
        totals = len({point.key for point in asked.points}), len(set(asked.latencies))
        points, latencies = totals if key in self._whole else self._reader.counts(asked)
        if (points, latencies) == totals:
            self._whole.add(key)  # and stays so
        state: SweepState = "done" if key in self._whole else "partial"
        change = {"points_total": totals[0], "points_done": points, "latencies_total": totals[1], "latencies_done": latencies}
        return fresh_progress(state).model_copy(update=change)


def _status(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_mtime_ns, status.st_size


def _of_queue(queued: QueuedSweep, kept: KeptSweep | None, sources: dict[str, str]) -> Sweep:
    request = queued.request
    return Sweep(
        id=queued.id,
        origin="service",
        created_at=queued.created_at,
        clips=_clips(kept.asked, sources) if kept else [],
        upscalers=list(request.upscalers),
        low_heights=list(kept.asked.low_heights) if kept else [],
        bitrates_kbps=sorted(request.bitrates_kbps),
        progress=queued.progress,
        failures=list(queued.failures),
    )


def _clips(asked: AskedSweep, sources: dict[str, str]) -> list[ClipOfSweep]:
    return [
        ClipOfSweep(
            clip=clip.name,
            sha256=clip.sha256,
            width=clip.width,
            height=clip.height,
            fps=clip.fps,
            frames=clip.frames,
            source=sources.get(clip.sha256),
        )
        for clip in asked.clips
    ]
