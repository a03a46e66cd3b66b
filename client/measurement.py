"""One timed run of one model on one clip, in a process of its own."""

from __future__ import annotations

import itertools
import multiprocessing
import re
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeVar

from client.artifact import ModelSpec
from client.errors import GamesrError, InputError
from client.pipeline import upscale_stream
from client.sink import NullSink
from client.timing import LatencySummary, Stamps, stage_latencies
from client.upscaler import OnnxUpscaler
from client.video import VideoSource

WARM_UP_FRAMES = 5
Argument = TypeVar("Argument")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Task:
    """What is to be run: at most `frames` frames of the clip count, those after the warm-up."""

    model: Path
    clip: Path
    frames: int
    provider: str
    threads: int | None


@dataclass(frozen=True)
class Run:
    """What one run took.

    `stamps` are of the frames that count. `first_frame_ms` is the time to load the model and that of its first step.
    `peak_memory_mib` is the largest resident size of the whole process, None where the system does not tell.
    """

    spec: ModelSpec
    threads: int
    width: int
    height: int
    stamps: Sequence[Stamps]
    first_frame_ms: float
    peak_memory_mib: float | None

    @property
    def latency_us(self) -> dict[str, LatencySummary]:
        """By stage: decode, upscale, write (handed to a sink that forgets it), total."""
        return stage_latencies(self.stamps)

    @property
    def fps(self) -> float:
        """Frames per second of total."""
        return len(self.stamps) / (sum(s.written_ns - s.packet_ns for s in self.stamps) / 1e9)


def measure(task: Task) -> Run:
    """Upscale the clip into nothing, in this process; raises GamesrError, also for a clip that is over before the warm-up is."""
    with VideoSource(task.clip) as source:
        begin_ns = time.perf_counter_ns()
        upscaler = OnnxUpscaler(task.model, provider=task.provider, threads=task.threads)
        load_ns = time.perf_counter_ns() - begin_ns
        stream = upscale_stream(source, upscaler, NullSink())
        stamps = [done.stamps for done in itertools.islice(stream, WARM_UP_FRAMES + task.frames)]
        counted = stamps[WARM_UP_FRAMES:]
        if not counted:
            raise InputError(f"{task.clip} has {len(stamps)} frames, of which {WARM_UP_FRAMES} are warm-up: use a longer clip")
        return Run(
            spec=upscaler.spec,
            threads=upscaler.threads,
            width=source.width,
            height=source.height,
            stamps=counted,
            first_frame_ms=(load_ns + stamps[0].upscaled_ns - stamps[0].decoded_ns) / 1e6,
            peak_memory_mib=_peak_memory_mib(),
        )


def measure_in_fresh_process(task: Task) -> Run:
    """`measure`, where no earlier run has left memory or warmth behind; raises what it raises."""
    return in_fresh_process(measure, task, f"the process that measured {task.model.name}")


def in_fresh_process(function: Callable[[Argument], Result], argument: Argument, what: str) -> Result:
    """`function(argument)` in a process of its own; raises the GamesrError that it raises, or that `what` ended when it dies."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_report, args=(function, argument, sender), daemon=True)
    process.start()
    sender.close()
    try:
        with receiver:
            outcome: Result | GamesrError = receiver.recv()
    except EOFError:
        process.join()
        raise GamesrError(f"{what} ended with status {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
        process.close()
    if isinstance(outcome, GamesrError):
        raise outcome
    return outcome


def _report(function: Callable[[Argument], Result], argument: Argument, sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it too, and ends this process
    try:
        sender.send(function(argument))
    except GamesrError as error:
        sender.send(error)


def _peak_memory_mib() -> float | None:
    # Not getrusage: a child's ru_maxrss begins at the size of the process that it was forked from.
    status = Path("/proc/self/status")
    found = re.search(r"^VmHWM:\s*(\d+) kB", status.read_text(), re.MULTILINE) if status.is_file() else None
    return int(found[1]) / 1024 if found else None
