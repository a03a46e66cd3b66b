"""The process of one sweep that was asked for over HTTP: it plans, measures, and reports how far it is."""

from __future__ import annotations

import logging
import os
import time
from contextlib import closing
from pathlib import Path

from client.errors import GamesrError, InputError
from server.clips import SCALES
from server.database import Database
from server.events import (
    Event,
    LatencyDone,
    LatencyFailed,
    LatencyReused,
    PlanMade,
    PointDone,
    PointFailed,
    PointReused,
    Waiting,
    failure_record,
)
from server.following import end_with_parent
from server.library import Library
from server.plan import Request, make_plan
from server.queue import QueuedSweep, SweepQueue, fresh_progress
from server.schemas import Failure, Progress
from server.settings import Settings
from server.store import Store
from server.sweep import run_sweep
from server.workers import LocalWorkers

NICENESS = 10
MOST_FAILURES = 200
_LOG = logging.getLogger(__name__)


def run_queued(settings: Settings, sweep: str) -> None:
    """Run a sweep of the queue that was taken from it, beside whatever this machine is really for; its end is in the queue."""
    os.nice(NICENESS)
    end_with_parent()
    database = Database(settings.database)
    queue = SweepQueue(database, most=settings.limits.queued_sweeps, kept=settings.limits.kept_sweeps)
    library = Library(database, settings)
    queued = queue[sweep]
    paths = {name: library.path(name) for name in queued.request.clips}
    try:
        progress = _run(settings, queue, queued, paths)
    except GamesrError as error:
        queue.end(sweep, "failed", _without_paths(str(error), paths))
    except Exception:
        _LOG.exception("sweep %s", sweep)
        queue.end(sweep, "failed", "an error of the service ended it: see its log")
    else:
        nothing = not progress.points_done and progress.points_failed
        queue.end(sweep, "failed" if nothing else "done", "no point could be measured: see the failures" if nothing else None)


def _run(settings: Settings, queue: SweepQueue, queued: QueuedSweep, paths: dict[str, Path | None]) -> Progress:
    asked = queued.request
    gone = [name for name, path in paths.items() if path is None]
    if gone:
        raise InputError(f"clip {gone[0]} is not there any more")
    request = Request(
        clips=[path for path in paths.values() if path],
        names=list(paths),
        bitrates_kbps=asked.bitrates_kbps,
        upscalers=asked.upscalers,
        heights=asked.low_heights,
        scales=asked.scales or SCALES,
        fps=asked.fps,
        frames=asked.frames,
    )
    plan = make_plan(request)
    tracker = Tracker(paths)
    with Store(settings.store) as store, closing(run_sweep(plan, store, LocalWorkers(settings.jobs))) as events:
        for event in events:
            tracker.take(event)
            queue.report(queued.id, tracker.progress, tracker.failures, plan.asked.key)
    return tracker.progress


class Tracker:
    """What the events of a sweep come to: `progress`, and the `failures` that a reader has to know of."""

    def __init__(self, paths: dict[str, Path | None]) -> None:
        self._paths = paths
        self._begin = time.monotonic()
        self._measured = 0
        self.failures: list[Failure] = []
        self.progress = fresh_progress("running")

    def take(self, event: Event) -> None:
        before, change = self.progress, dict[str, object](waiting=None)
        match event:
            case PlanMade(points, latencies):
                change |= {"points_total": points, "latencies_total": latencies}
            case PointDone() | PointReused():
                change["points_done"] = before.points_done + 1
            case PointFailed():
                change["points_failed"] = before.points_failed + 1
                self._failed(event)
            case LatencyDone() | LatencyReused():
                change["latencies_done"] = before.latencies_done + 1
            case LatencyFailed():
                change["latencies_failed"] = before.latencies_failed + 1
                self._failed(event)
            case Waiting(reason):
                change["waiting"] = reason
        self._measured += isinstance(event, PointDone | PointFailed)
        after = before.model_copy(update=change)
        elapsed_s = time.monotonic() - self._begin
        remaining_s = None
        if self._measured and after.points_total is not None:
            remaining_s = elapsed_s / self._measured * (after.points_total - after.points_done - after.points_failed)
        self.progress = after.model_copy(update={"elapsed_s": elapsed_s, "remaining_s": remaining_s})

    def _failed(self, failed: PointFailed | LatencyFailed) -> None:
        if len(self.failures) < MOST_FAILURES:
            self.failures.append(Failure(**failure_record(failed) | {"reason": _without_paths(failed.reason, self._paths)}))


def _without_paths(sentence: str, paths: dict[str, Path | None]) -> str:
    """The names that the caller knows in the place of files that are none of its business."""
    for name, path in paths.items():
        if path is not None:
            sentence = sentence.replace(str(path.absolute()), name).replace(str(path), name)
    return sentence
