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
from client.errors import InputError
from client.measurement import WARM_UP_FRAMES, Task, in_fresh_process, measure
from client.timing import Stamps, deadline_misses, stage_latencies
from client.video import VideoSource
from server.encoding import EncodedStream
from server.job import Ask, Job, low_frames, settings
from server.points import DEADLINES_FPS, LatencyResult

FRAMES = 100  # that count: fewer have no 99th percentile


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
    """As many frames as latency is measured on, in a file for as long as the context lasts; raises what encoding raises."""
    encoder = settings(job.asks[0].point)
    with tempfile.TemporaryDirectory(prefix="gamesr-sweep-") as folder:
        path = Path(folder) / "stream.h264"
        with closing(low_frames(job)) as frames, EncodedStream(islice(frames, WARM_UP_FRAMES + FRAMES), encoder) as encoded:
            with path.open("wb") as file:
                encoded.write(file)
            yield Stream(path, encoded.bitrate_kbps)


def measure_latency(ask: Ask, stream: Stream) -> LatencyResult:
    """Play the stream through the upscaler in a process of its own, with as many threads as a player would have.

    Raises GamesrError, also for a stream that is over before the warm-up is.
    """
    point = ask.point
    played = in_fresh_process(_play, _Task(ask.model, stream.path), f"the process that measured {point.upscaler}")
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
    model: Path | None
    stream: Path


def _play(task: _Task) -> list[Stamps]:
    if task.model is not None:
        return list(measure(Task(task.model, task.stream, FRAMES, "cpu", None)).stamps)
    with VideoSource(task.stream) as source:
        times = [(decoded.packet_ns, decoded.decoded_ns) for decoded in islice(source, WARM_UP_FRAMES, None)]
    if not times:
        raise InputError(f"the clip has at most {WARM_UP_FRAMES} frames, which are warm-up: use a longer one")
    return [Stamps(packet_ns, decoded_ns, decoded_ns, decoded_ns) for packet_ns, decoded_ns in times]
