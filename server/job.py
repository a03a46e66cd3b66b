"""The work of a sweep: one encode, and every upscaler that is asked for on it, in whatever process a job happens to run."""

from __future__ import annotations

import hashlib
import time
import traceback
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

from client.cloud import CloudSettings, area_downscale
from client.errors import GamesrError, InputError, ModelError
from client.frames import Frame
from client.pipeline import upscale_stream
from client.quality import QualityMeter
from client.sink import NullSink
from client.upscaler import OnnxUpscaler
from server.encoding import EncodedStream, clip_frames
from server.lpips import Lpips
from server.names import shown
from server.points import Flag, Point, PointResult
from server.versions import versions

# Of the bitrate asked for: beyond it the point is flagged. Within it lies what rate control is off by on a clip of a second.
TOLERANCE = 0.1
Item = TypeVar("Item")
NOT_PLANNED = "{} is not the file that was planned with: it changed, or is another one on this machine"
REFUSALS = (GamesrError, MemoryError, OSError)


@dataclass(frozen=True)
class Ask:
    """One point and the artifact that makes it; None for the upscaler `none`."""

    point: Point
    model: Path | None


@dataclass(frozen=True)
class Job:
    """Points that share an encode. `low` is a clip rendered small, None to downscale `clip`; every `step`-th frame counts."""

    clip: Path
    low: Path | None
    step: int
    lpips: Path | None
    asks: tuple[Ask, ...]


@dataclass(frozen=True)
class Measured:
    """A finished point, and the seconds that went into its encode, decodes, inferences and metrics."""

    result: PointResult
    work_s: float


@dataclass(frozen=True)
class Failed:
    """A point that could not be measured: why, in one sentence, and where in the code."""

    point: Point
    reason: str
    trace: str


Outcome = Measured | Failed


class _Work:
    """Seconds spent on what a sweep cannot do without: what remains of the time is the harness."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self._begin = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._begin

    def each(self, items: Iterable[Item]) -> Iterator[Item]:
        """The same items; the time that they take to come is work."""
        iterator = iter(items)
        while True:
            with self:
                item = next(iterator, None)
            if item is None:
                return
            yield item

    def take(self) -> float:
        seconds, self.seconds = self.seconds, 0.0
        return seconds


def run_job(job: Job) -> Iterator[Outcome]:
    """One outcome for every point, each as soon as it is there; what goes wrong with a point is an outcome and not raised."""
    work = _Work()
    try:
        stream = _encode(job, work)
    except REFUSALS as error:
        yield from [_failed(ask, error) for ask in job.asks]
        return
    with stream:
        for ask in job.asks:
            try:
                result = _measure(job, ask, stream, work)
            except REFUSALS as error:
                yield _failed(ask, error)
            else:
                yield Measured(result, work.take())


def low_frames(job: Job) -> Generator[Frame]:
    """What is to be encoded: the clip itself, the clip downscaled by area, or the clip that was rendered small."""
    point = job.asks[0].point
    for frame in clip_frames(job.low or job.clip, job.step, point.frames):
        yield frame if job.low or point.scale == 1 else area_downscale(frame, point.scale)


def settings(point: Point) -> CloudSettings:
    return CloudSettings(bitrate_kbps=point.requested_kbps, fps=point.fps)


def content_sha256(path: Path) -> str:
    """The sha256 of a file's bytes, read once for as long as the file does not change; raises InputError."""
    try:
        status = path.stat()
        return _content_sha256(path, status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error


@cache
def _content_sha256(path: Path, size: int, modified_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_clips(job: Job) -> None:
    """Raises InputError where the clip, or the one that was rendered small, is not what was planned with."""
    point = job.asks[0].point
    for path, expected in ((job.clip, point.clip_sha256), (job.low, point.low_sha256)):
        if path is not None and content_sha256(path) != expected:
            raise InputError(NOT_PLANNED.format(path))


def sentence(error: Exception) -> str:
    """What to say of one of `REFUSALS`."""
    if isinstance(error, MemoryError):
        return "there was not enough memory: use fewer --jobs"
    return f"working files cannot be written: {error.strerror}" if isinstance(error, OSError) else shown(str(error))


def _failed(ask: Ask, error: Exception) -> Failed:
    return Failed(ask.point, sentence(error), "".join(traceback.format_exception(error)))


def _encode(job: Job, work: _Work) -> EncodedStream:
    point = job.asks[0].point
    check_clips(job)
    for name, version in versions(point.width, point.height).items():
        if version != point.versions[name]:
            raise GamesrError(f"{name} is {version} on this machine, but was {point.versions[name]} at planning: install the same one")
    with work, closing(low_frames(job)) as frames:
        return EncodedStream(frames, settings(point))


def _measure(job: Job, ask: Ask, stream: EncodedStream, work: _Work) -> PointResult:
    point = ask.point
    upscaler = _upscaler(ask)
    with ExitStack() as stack:
        references = stack.enter_context(closing(clip_frames(job.clip, job.step, point.frames)))
        meter = stack.enter_context(QualityMeter(point.width, point.height, vmaf_threads=1))
        lpips = _lpips(job.lpips, point) if job.lpips else None
        for index, picture in enumerate(work.each(_pictures(stream, upscaler))):
            with work:
                reference = next(references, None)
                if reference is None:
                    raise _of_another_length(job)
                meter.add(reference, picture)
                if lpips:
                    lpips.add(index, reference, picture)
        with work:
            if next(references, None) is not None:
                raise _of_another_length(job)
            quality = meter.result()
    distance = lpips.result() if lpips else None
    reason = "the LPIPS model gave a number that is not finite" if lpips else "no LPIPS model was given (--lpips FILE)"
    return PointResult(
        point=point,
        bitrate_kbps=stream.bitrate_kbps,
        flags=_flags(stream.bitrate_kbps, point.requested_kbps),
        quality=quality,
        lpips=distance,
        lpips_undefined=reason if distance is None else None,
    )


def _upscaler(ask: Ask) -> OnnxUpscaler | None:
    if ask.model is None:
        return None
    upscaler = OnnxUpscaler(ask.model, threads=1)
    if upscaler.spec.sha256 != ask.point.upscaler_sha256:
        raise ModelError(NOT_PLANNED.format(ask.model))
    return upscaler


def _lpips(path: Path, point: Point) -> Lpips:
    lpips = Lpips(path, threads=1)
    if lpips.version != point.versions["lpips"]:
        raise ModelError(NOT_PLANNED.format(path))
    return lpips


def _pictures(stream: EncodedStream, upscaler: OnnxUpscaler | None) -> Iterator[Frame]:
    """What a player sees of the stream."""
    if upscaler is None:
        yield from (decoded.frame for decoded in stream)
    else:
        yield from (done.picture for done in upscale_stream(stream, upscaler, NullSink()))


def _flags(bitrate_kbps: float, requested_kbps: int) -> tuple[Flag, ...]:
    if bitrate_kbps > requested_kbps * (1 + TOLERANCE):
        return (Flag.ABOVE,)
    return (Flag.BELOW,) if bitrate_kbps < requested_kbps * (1 - TOLERANCE) else ()


def _of_another_length(job: Job) -> InputError:
    return InputError(f"{job.low or 'the encode'} has not as many frames as {job.clip}: give --frames, or clips of one length")
