"""Video through pipes: what can be read from its beginning on standard input, raw pictures on standard output."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import av
from av.video.stream import VideoStream

from client.errors import InputError, OutputError
from client.frames import Frame
from client.sink import untagged
from client.video import CONTAINERS, OpenVideo
from client.y4m import Y4mWriter

PIPE = Path("-")  # as an argument: standard input, standard output
# H.273 code points as ffmpeg calls them.
_MATRICES = {1: "bt709", 4: "fcc", 5: "bt470bg", 6: "smpte170m", 7: "smpte240m", 9: "bt2020nc", 10: "bt2020c"}


def path_or_pipe(text: str) -> Path:
    """An argument's type; "./-" is a file, of which a Path alone would make "-"."""
    path = Path(text)
    return path.absolute() if path == PIPE and text != str(PIPE) else path


class PipedVideo(OpenVideo):
    """The video stream of a pipe: .y4m, MPEG-TS, Matroska, raw H.264 and whatever else needs no second look; raises InputError.

    What a signal raises while the pipe is read, such as KeyboardInterrupt, comes out of here, and is not taken for the pipe's end.
    """

    def __init__(self, pipe: BinaryIO) -> None:
        self._reader = _Reader(pipe)
        try:
            # Nothing but the pipe is opened, whatever is written in it.
            options = {"protocol_whitelist": "pipe", "format_whitelist": CONTAINERS}
            try:
                container = av.open(self._reader, "r", options=options, metadata_errors="replace")
            finally:
                self._reader.check()
        except (av.FFmpegError, OSError) as error:
            raise InputError("standard input holds no video that can be read from its beginning (an .mp4 has to be a file)") from error
        super().__init__("standard input", container)

    def packets(self) -> Iterator[av.Packet[VideoStream]]:
        for packet in super().packets():
            self._reader.check()
            yield packet


class _Reader:
    """Reads for FFmpeg, through which only an Exception gets: after anything that was raised the pipe is at its end."""

    def __init__(self, pipe: BinaryIO) -> None:
        self._pipe = pipe
        self._raised: BaseException | None = None
        self.seek, self.tell, self.seekable = pipe.seek, pipe.tell, pipe.seekable  # of a file that stands for a pipe

    def read(self, size: int) -> bytes:
        if self._raised is not None:
            return b""
        try:
            return self._pipe.read(size)
        except BaseException as error:
            self._raised = error
            return b""

    def check(self) -> None:
        """Raise what reading raised."""
        if self._raised is not None:
            raise self._raised


class PipeSink:
    """Writes pictures as .y4m into a pipe, at the rate that the source names. Raises OutputError, and BrokenPipeError when nobody reads.

    `notes` says what of the source .y4m cannot hold.
    """

    def __init__(self, pipe: BinaryIO, source: OpenVideo) -> None:
        self._pipe, self._source = pipe, source
        self._writer: Y4mWriter | None = None
        self._size = 0, 0
        self._first_pts: int | None = None
        self._written = 0
        self._astray_s = Fraction(0)  # how far from its time a picture comes at most
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        uneven = self._astray_s > 1 / self._source.frame_rate / 2  # less is what a container rounds off
        astray = f".y4m holds one rate, so frames come up to {float(self._astray_s):.2f} s from their time"
        return self._notes + ([astray] if uneven else [])

    def write(self, frame: Frame) -> None:
        if self._writer is None:
            source = self._source
            self._writer = Y4mWriter(self._pipe, frame, source.frame_rate, sample_aspect_ratio=source.sample_aspect_ratio)
            self._size = frame.width, frame.height
            self._first_pts = frame.pts
            self._notes = _not_held(source, frame.colour.matrix) + untagged(source, frame)
        if (frame.width, frame.height) != self._size:
            before, now = (f"{width}x{height}" for width, height in (self._size, (frame.width, frame.height)))
            raise OutputError(f"the picture changes in mid-stream, {before} becomes {now} upscaled, which .y4m cannot hold")
        self._writer.picture(frame)
        if frame.pts is not None and self._first_pts is not None:
            at_s = (frame.pts - self._first_pts) * (frame.time_base or self._source.time_base)
            self._astray_s = max(self._astray_s, abs(at_s - self._written / self._source.frame_rate))
        self._written += 1


def _not_held(source: OpenVideo, matrix: int) -> list[str]:
    notes = []
    if source.has_sound:
        notes.append(".y4m holds the picture alone: the sound is left out")
    if source.display_matrix is not None:
        notes.append(".y4m does not say that the picture is to be shown turned or mirrored")
    if matrix in _MATRICES:
        notes.append(f".y4m does not say that the colours are {_MATRICES[matrix]}: give the next encoder -colorspace {_MATRICES[matrix]}")
    return notes
