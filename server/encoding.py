"""A clip as the cloud sends it: encoded once, decoded as often as there are upscalers."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import av
from av.codec.context import Flags

from client.cloud import CloudEncoder, CloudSettings
from client.errors import InputError
from client.frames import Frame
from client.video import Decoded, VideoSource, from_av_frame
from client.whole_frames import whole_frames


def clip_frames(path: Path, step: int, limit: int | None) -> Generator[Frame]:
    """Every `step`-th frame of a file, at most `limit`; raises InputError for a file that is unreadable or, up to there, not whole."""
    with VideoSource(path) as source:
        yield from islice(whole_frames(source), 0, limit and (limit - 1) * step + 1, step)


class EncodedStream:
    """Frames encoded by `CloudEncoder`; a context manager, iterated any number of times for what a client decodes of them.

    The packets lie in a temporary file without a name, so memory stays bounded and nothing is left behind by a process that
    is killed. Every iteration has a decoder of its own, with one thread and without a frame of lag.
    """

    def __init__(self, frames: Iterable[Frame], settings: CloudSettings) -> None:
        self.frames = 0
        self._fps = settings.fps
        self._packet_bytes: list[int] = []
        with ExitStack() as stack:
            self._file = stack.enter_context(tempfile.TemporaryFile(prefix="gamesr-sweep-"))
            try:
                self._encode(frames, settings)
            except av.FFmpegError as error:
                raise InputError(f"x264 cannot encode this at {settings.bitrate_kbps} kbps: {error.strerror}") from error
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.close()

    @property
    def bitrate_kbps(self) -> float:
        """The true bitrate: every bit of every packet over the time that the frames last."""
        return sum(self._packet_bytes) * 8 * self._fps / self.frames / 1000

    def __iter__(self) -> Iterator[Decoded]:
        decoder = av.CodecContext.create("h264", "r")
        decoder.thread_count = 1
        decoder.flags |= Flags.low_delay
        offset = 0
        for size in self._packet_bytes:
            self._file.seek(offset)
            offset += size
            packet = av.Packet(self._file.read(size))
            packet_ns = time.perf_counter_ns()
            for picture in decoder.decode(packet):
                yield Decoded(from_av_frame(picture), packet_ns, time.perf_counter_ns())

    def write(self, target: BinaryIO) -> None:
        """The packets as they are, one after the other: raw H.264 (Annex B)."""
        self._file.seek(0)
        while block := self._file.read(2**20):
            target.write(block)

    def _encode(self, frames: Iterable[Frame], settings: CloudSettings) -> None:
        encoder: CloudEncoder | None = None
        for frame in frames:
            encoder = encoder or CloudEncoder(settings, frame.width, frame.height, frame.colour)
            self._keep(encoder.encode(frame))
            self.frames += 1
        self._keep(encoder.flush() if encoder else [])

    def _keep(self, packets: Iterable[bytes]) -> None:
        for packet in packets:
            self._file.write(packet)
            self._packet_bytes.append(len(packet))
