"""Jobs on the processes of this machine, each with one thread for its encoder, its network and its metrics."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Iterator
from multiprocessing.connection import Connection, wait
from typing import Protocol

from server.following import end_with_parent
from server.job import Failed, Job, Outcome, run_job

_BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_END_S = 10.0


class Workers(Protocol):
    """Whatever computes jobs; the local processes and a cluster are two of it."""

    @property
    def count(self) -> int:
        """Jobs that are worked on at the same time."""

    def run(self, jobs: Iterator[Job]) -> Iterator[Outcome]:
        """The outcome of every point of every job, in the order in which they come; takes a job when a worker is free for it."""


class LocalWorkers:
    """At most `count` processes, started fresh (spawn). One that dies fails the points it was at, and another takes its place."""

    def __init__(self, count: int) -> None:
        self.count = count

    def run(self, jobs: Iterator[Job]) -> Iterator[Outcome]:
        at_work: dict[Connection, _Worker] = {}
        idle: list[_Worker] = []
        try:
            while True:
                while len(at_work) < self.count and (job := next(jobs, None)):
                    worker = idle.pop() if idle else _Worker()
                    worker.begin(job)
                    at_work[worker.connection] = worker
                if not at_work:
                    return
                for connection in wait(list(at_work)):
                    assert isinstance(connection, Connection)
                    worker = at_work[connection]
                    yield from worker.outcomes()
                    if not worker.missing:
                        del at_work[connection]
                        if worker.alive:
                            idle.append(worker)
                        else:
                            worker.end()
        finally:
            left = (*at_work.values(), *idle)
            for worker in left:
                worker.stop()
            for worker in left:
                worker.end()


class _Worker:
    """One process and the points that it still owes."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs,), daemon=True)
        with _one_thread_each():
            self._process.start()
        theirs.close()
        self.alive = True
        self.missing: dict[str, Failed] = {}  # by key: what there is to say of it should the process die

    def begin(self, job: Job) -> None:
        reason = "its worker process ended before it was done: too little memory is the usual reason, use fewer --jobs"
        self.missing = {ask.point.key: Failed(ask.point, reason, "") for ask in job.asks}
        with contextlib.suppress(OSError):  # a process that died since shows when it is read from
            self.connection.send(job)

    def outcomes(self) -> Iterator[Outcome]:
        """What has come in: one outcome, or failures for everything that a dead process still owed."""
        try:
            outcome: Outcome = self.connection.recv()
        except (EOFError, OSError):
            self.alive = False
            yield from self.missing.values()
            self.missing = {}
        else:
            point = outcome.point if isinstance(outcome, Failed) else outcome.result.point
            del self.missing[point.key]
            yield outcome

    def stop(self) -> None:
        """Ask the process to end; it stops its own VMAF and removes that one's folder first."""
        self._process.terminate()

    def end(self) -> None:
        """See the process gone, whether it was asked or not."""
        self._process.join(_END_S)
        self._process.kill()
        self._process.join()
        self._process.close()
        self.connection.close()


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    # numpy's BLAS reads these when it is loaded, which in a fresh process is before any line of ours runs.
    before = {name: os.environ.get(name) for name in _BLAS_THREADS}
    os.environ.update(dict.fromkeys(_BLAS_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(connection: Connection) -> None:
    end_with_parent()  # nobody is left to take a result
    while True:
        try:
            job: Job = connection.recv()
        except (EOFError, OSError):
            return
        for outcome in run_job(job):
            connection.send(outcome)
