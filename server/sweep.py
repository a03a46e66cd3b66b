"""The sweep itself: from a plan to a store full of results, as a stream of events."""

from __future__ import annotations

import time
import traceback
from collections.abc import Generator, Iterator
from contextlib import ExitStack
from dataclasses import replace

from server.events import (
    Event,
    LatencyDone,
    LatencyFailed,
    LatencyReused,
    PlanMade,
    PointDone,
    PointFailed,
    PointReused,
    SweepDone,
    Waiting,
)
from server.job import REFUSALS, Failed, Job, Outcome, sentence
from server.latency import Stream, encoded_beginning, latency_key, measure_latency
from server.plan import Plan
from server.store import Store
from server.workers import Workers

_POLL_S = 0.5


def run_sweep(plan: Plan, store: Store, workers: Workers) -> Generator[Event]:
    """Measure what the store lacks of the plan: all points, then, when nothing else runs, all latencies.

    Closing the iterator stops the workers; what was finished is in the store. Raises OutputError where the store cannot be
    written; a point that cannot be measured is an event.
    """
    store.keep_sweep(plan.asked)
    latencies = sum(len(job.asks) for job in plan.latency_jobs)
    yield PlanMade(len(plan.points), latencies, workers.count)
    points = _Points(plan, store, workers)
    yield from points.run()
    yield from _run_latencies(plan, store)
    yield SweepDone(points.done, points.reused, points.failed, points.work_s, points.worker_s)


class _Points:
    """The points of a plan: each one reused, computed here, or waited for while another sweep computes it."""

    def __init__(self, plan: Plan, store: Store, workers: Workers) -> None:
        self._store, self._workers = store, workers
        self._left = list(plan.jobs)  # with the points that are neither stored, failed nor claimed here
        self._begun = 0
        self.done = self.reused = self.failed = 0
        self.work_s = self.worker_s = 0.0

    def run(self) -> Iterator[Event]:
        waiting = False
        while True:
            yield from self._stored()
            if not self._left:
                return
            begin, self._begun = time.perf_counter(), 0
            for outcome in self._workers.run(self._claimed()):
                yield self._keep(outcome)
            self.worker_s += (time.perf_counter() - begin) * min(self._begun, self._workers.count)
            if not self._begun:
                if not waiting:
                    yield Waiting("another sweep on this store is at work on what is left")
                waiting = True
                time.sleep(_POLL_S)

    def _stored(self) -> Iterator[Event]:
        left = []
        for job in self._left:
            asks = []
            for ask in job.asks:
                result = self._store.point(ask.point.key)
                if result is None:
                    asks.append(ask)
                else:
                    self.reused += 1
                    yield PointReused(replace(result, point=ask.point))  # its names are of whoever measured it
            if asks:
                left.append(replace(job, asks=tuple(asks)))
        self._left = left

    def _claimed(self) -> Iterator[Job]:
        """Jobs with the points that are now this sweep's to compute; advanced when a worker is free for one."""
        jobs, self._left = self._left, []
        for job in jobs:
            mine = set(self._store.claim([ask.point.key for ask in job.asks]))
            parts = [tuple(ask for ask in job.asks if (ask.point.key in mine) == claimed) for claimed in (True, False)]
            if parts[1]:
                self._left.append(replace(job, asks=parts[1]))
            if parts[0]:
                self._begun += 1
                yield replace(job, asks=parts[0])

    def _keep(self, outcome: Outcome) -> Event:
        if isinstance(outcome, Failed):
            self._store.release(outcome.point.key)
            self.failed += 1
            return PointFailed(outcome.point, outcome.reason, outcome.trace)
        self._store.keep_point(outcome.result)
        self.done += 1
        self.work_s += outcome.work_s
        return PointDone(outcome.result)


def _run_latencies(plan: Plan, store: Store) -> Iterator[Event]:
    if all(store.latency(latency_key(ask)) for job in plan.latency_jobs for ask in job.asks):
        for job in plan.latency_jobs:
            yield from _latencies(job, store)
        return
    if not store.claim_alone():
        yield Waiting("latency is measured when nothing else runs: another sweep on this store has to end first")
        while not store.claim_alone():
            time.sleep(_POLL_S)
    try:
        for job in plan.latency_jobs:
            yield from _latencies(job, store)
    finally:
        store.release_alone()


def _latencies(job: Job, store: Store) -> Iterator[Event]:
    """The latencies of one encode, from the store or else measured; the clip is encoded when the first one is missing."""
    with ExitStack() as stack:
        stream: Stream | None = None
        for ask in job.asks:
            point, key = ask.point, latency_key(ask)
            found = store.latency(key)
            if found is not None:
                yield LatencyReused(replace(found, clip=point.clip, upscaler=point.upscaler))
                continue
            try:
                stream = stream or stack.enter_context(encoded_beginning(job))
                result = measure_latency(ask, stream)
            except REFUSALS as error:
                trace = "".join(traceback.format_exception(error))
                yield LatencyFailed(point.clip, point.low_height, point.upscaler, sentence(error), trace)
            else:
                store.keep_latency(key, result)
                yield LatencyDone(result)
