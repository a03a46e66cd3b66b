"""Video through pipes: what can be read from its beginning on standard input, raw pictures on standard output."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import av

from client.errors import InputError, OutputError
from client.frames import Frame
from client.video import CONTAINERS, OpenVideo
from client.y4m import Y4mWriter

PIPE = Path("-")  # as an argument: standard input, standard output


class PipedVideo(OpenVideo):
    """The video stream of a pipe: .y4m, MPEG-TS, Matroska, raw H.264 and whatever else needs no second look; raises InputError."""

    def __init__(self, pipe: BinaryIO) -> None:
        try:
            # Nothing but the pipe is opened, whatever is written in it.
            options = {"protocol_whitelist": "pipe", "format_whitelist": CONTAINERS}
            container = av.open(pipe, "r", options=options, metadata_errors="replace")
        except (av.FFmpegError, OSError) as error:
            raise InputError("standard input holds no video that can be read from its beginning (an .mp4 has to be a file)") from error
        super().__init__("standard input", container)


class PipeSink:
    """Writes pictures as .y4m into a pipe, at the rate that the source names. Raises OutputError, and BrokenPipeError when nobody reads."""

    notes: tuple[str, ...] = ()

    def __init__(self, pipe: BinaryIO, source: OpenVideo) -> None:
        self._pipe, self._source = pipe, source
        self._writer: Y4mWriter | None = None
        self._size = 0, 0

    def write(self, frame: Frame) -> None:
        if self._writer is None:
            source = self._source
            self._writer = Y4mWriter(self._pipe, frame, source.frame_rate, sample_aspect_ratio=source.sample_aspect_ratio)
            self._size = frame.width, frame.height
        if (frame.width, frame.height) != self._size:
            before, now = (f"{width}x{height}" for width, height in (self._size, (frame.width, frame.height)))
            raise OutputError(f"the picture changes in mid-stream, {before} becomes {now} upscaled, which .y4m cannot hold")
        self._writer.picture(frame)
