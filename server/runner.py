"""gamesr-runner: takes the sweeps that wait in a service's folder and runs them, one at a time, each in a process of its own."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import logging
import multiprocessing
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Self

from client.command import command_parser, fail, whole_number
from client.cores import physical_cores
from client.errors import GamesrError, InputError, OutputError
from server.database import Database
from server.following import end_with_parent
from server.queue import SweepQueue
from server.run import run_queued
from server.settings import Settings

PROGRAM = "gamesr-runner"
EXAMPLES = """\
example:
  gamesr-serve --no-runner --data /srv/gamesr --store /srv/sweep.sqlite --clips /srv/clips
  gamesr-runner --data /srv/gamesr --store /srv/sweep.sqlite --clips /srv/clips
      the service in one container, its sweeps in another, which may have more cores

It waits for sweeps until it is stopped, and says on stderr what it runs. Exit status: 0 stopped, 1 refused (one sentence says why), 2
wrong usage.
"""
_POLL_S = 0.2
_END_S = 15.0
_AGAIN_S = 1.0
_LOG = logging.getLogger(__name__)


def run_queue(settings: Settings) -> None:
    """Run sweeps until the process is ended; waits while another runner is at work on the same folder.

    A sweep that runs when this ends, or ended without a word, waits again and goes on with what the store lacks.
    """
    database = Database(settings.database)
    queue = SweepQueue(database, most=settings.limits.queued_sweeps, kept=settings.limits.kept_sweeps)
    with _locked(settings.data):
        queue.put_back()
        try:
            while True:
                sweep = queue.take()
                if sweep is None:
                    time.sleep(_POLL_S)
                else:
                    _run(settings, queue, sweep)
        finally:
            queue.put_back()


def runs(data: Path) -> bool:
    """Whether a runner is at work on this folder."""
    try:
        with _lock_file(data).open("a") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


class RunnerProcess:
    """A runner beside the service, begun again should it die; a context manager."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._process = self._begin()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ending.set()
        self._thread.join()
        _end(self._process)

    def _begin(self) -> BaseProcess:
        process = multiprocessing.get_context("spawn").Process(target=_follow_and_run, args=(self._settings,))
        process.start()
        return process

    def _watch(self) -> None:
        while not self._ending.wait(_AGAIN_S):
            if not self._process.is_alive():
                _LOG.error("the runner ended with status %s and is begun again", self._process.exitcode)
                self._process = self._begin()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = command_parser(
        PROGRAM, "Run the sweeps that wait for a gamesr-serve that was started with --no-runner on the same folder and store.", EXAMPLES
    )
    add_folders(parser)
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    settings = Settings(arguments.store, arguments.data, arguments.clips, api_key=None, loopback=True, jobs=arguments.jobs)
    try:
        check_clips_folder(settings.clips)
        settings.data.mkdir(parents=True, exist_ok=True)
        run_queue(settings)
    except KeyboardInterrupt:
        return 0
    except OSError as error:
        return fail(PROGRAM, f"cannot use {settings.data}: {error.strerror}")
    except GamesrError as error:
        if arguments.debug:
            traceback.print_exc()
        return fail(PROGRAM, str(error))
    return 0


def add_folders(parser: argparse.ArgumentParser) -> None:
    """The arguments that a service and its runner have to agree on."""
    parser.add_argument(
        "--store", metavar="FILE", type=Path, default=Path("gamesr-sweep.sqlite"), help="gamesr-sweep's store (default: %(default)s)"
    )
    parser.add_argument(
        "--data", metavar="DIR", type=Path, default=Path("gamesr-serve"), help="queue, uploads and frames (default: %(default)s)"
    )
    parser.add_argument("--clips", metavar="DIR", type=Path, help="a folder whose clips may be swept by name")
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=whole_number(),
        default=physical_cores(),
        help="worker processes (default: the physical cores, %(default)s)",
    )


def check_clips_folder(clips: Path | None) -> None:
    """Raises InputError for what --clips names and is no folder."""
    if clips is not None and not clips.is_dir():
        raise InputError(f"{clips} is not a folder: --clips names the one whose clips may be swept")


def _follow_and_run(settings: Settings) -> None:
    end_with_parent()
    run_queue(settings)


def _run(settings: Settings, queue: SweepQueue, sweep: str) -> None:
    asked = queue[sweep].request
    _LOG.info("sweep %s begins: %s on %s", sweep, ", ".join(asked.upscalers), ", ".join(asked.clips))
    process = multiprocessing.get_context("spawn").Process(target=run_queued, args=(settings, sweep))
    process.start()
    try:
        while process.is_alive() and not queue[sweep].cancel:
            process.join(_POLL_S)
    finally:
        _end(process)
    if queue[sweep].cancel:
        queue.end(sweep, "cancelled")
    else:  # says nothing where the sweep has said how it ended
        queue.end(sweep, "failed", "its process ended before it was done: too little memory is the usual reason")
    end = queue[sweep].progress
    _LOG.info("sweep %s is %s: %d points are there, %d failed", sweep, end.state, end.points_done, end.points_failed)


def _end(process: BaseProcess) -> None:
    """Ask it to end, then see it gone."""
    process.terminate()
    process.join(_END_S)
    process.kill()
    process.join()


@contextlib.contextmanager
def _locked(data: Path) -> Iterator[None]:
    try:
        file = _lock_file(data).open("a")
    except OSError as error:
        raise OutputError(f"cannot write into {data}: {error.strerror}") from error
    with file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(_POLL_S)
        yield


def _lock_file(data: Path) -> Path:
    return data / "runner.lock"
