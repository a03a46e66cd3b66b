"""How long a client takes over each frame of a stream, on this machine, with nothing else of the sweep beside it."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from client.cores import machine_name, physical_cores
from client.errors import InputError, ModelError
from client.measurement import WARM_UP_FRAMES, Task, in_fresh_process, measure
from client.timing import Stamps, deadline_misses, stage_latencies
from client.video import VideoSource
from server.encoding import EncodedStream
from server.job import NOT_PLANNED, Ask, Job, check_clips, low_frames, settings
from server.points import DEADLINES_FPS, LatencyResult

FRAMES = 100  # that count: fewer have no 99th percentile


def unmeasured(frames: int | None) -> str | None:
    """Why there is no latency where at most so many frames of a clip count; None where there is one."""
    if frames is None or frames > WARM_UP_FRAMES:
        return None
    return f"the first {WARM_UP_FRAMES} frames are warm-up, and no more than {frames} were asked for"


def latency_key(ask: Ask) -> str:
    """The sha256 of what a latency depends on, as far as that can be known: the point, the processor, the threads, and the niceness."""
    niceness = os.nice(0)
    # Without a nought: a store's latencies, which were taken at none, keep their keys.
    content = [ask.point.key, machine_name(), physical_cores(), FRAMES, *([niceness] if niceness else [])]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


@dataclass(frozen=True)
class Stream:
    """The beginning of an encoded clip, as a file that a player would open."""

    path: Path
    bitrate_kbps: float


@contextmanager
def encoded_beginning(job: Job) -> Iterator[Stream]:
    """As many frames as latency is measured on, in a file for as long as the context lasts.

    Raises what encoding raises, and InputError for a clip that is another one by now, or over before the warm-up is.
    """
    check_clips(job)
    encoder = settings(job.asks[0].point)
    with tempfile.TemporaryDirectory(prefix="gamesr-sweep-") as folder:
        path = Path(folder) / "stream.h264"
        with closing(low_frames(job)) as frames, EncodedStream(islice(frames, WARM_UP_FRAMES + FRAMES), encoder) as encoded:
            if encoded.frames <= WARM_UP_FRAMES:
                raise InputError(f"{job.clip} has {encoded.frames} frames, of which {WARM_UP_FRAMES} are warm-up: use a longer clip")
            with path.open("wb") as file:
                encoded.write(file)
            yield Stream(path, encoded.bitrate_kbps)


def measure_latency(ask: Ask, stream: Stream) -> LatencyResult:
    """Play the stream through the upscaler in a process of its own, with as many threads as a player would have.

    Raises GamesrError, also for an artifact that is another one by now.
    """
    point = ask.point
    played = in_fresh_process(_play, _Task(ask, stream.path), f"the process that measured {point.upscaler}")
    stages = stage_latencies(played)
    if ask.model is None:
        stages = {stage: stages[stage] for stage in ("decode", "total")}
    totals_ns = [stamps.written_ns - stamps.packet_ns for stamps in played]
    return LatencyResult(
        clip=point.clip,
        clip_sha256=point.clip_sha256,
        width=point.width,
        height=point.height,
        low_height=point.low_height,
        bitrate_kbps=stream.bitrate_kbps,
        upscaler=point.upscaler,
        upscaler_sha256=point.upscaler_sha256,
        machine=machine_name(),
        threads=physical_cores(),
        latency_us=stages,
        deadline_misses={fps: deadline_misses(totals_ns, fps) for fps in DEADLINES_FPS},
    )


@dataclass(frozen=True)
class _Task:
    ask: Ask
    stream: Path


def _play(task: _Task) -> list[Stamps]:
    if task.ask.model is not None:
        run = measure(Task(task.ask.model, task.stream, FRAMES, "cpu", None))
        if run.spec.sha256 != task.ask.point.upscaler_sha256:
            raise ModelError(NOT_PLANNED.format(task.ask.model))
        return list(run.stamps)
    with VideoSource(task.stream) as source:
        times = [(decoded.packet_ns, decoded.decoded_ns) for decoded in islice(source, WARM_UP_FRAMES, None)]
    return [Stamps(packet_ns, decoded_ns, decoded_ns, decoded_ns) for packet_ns, decoded_ns in times]
