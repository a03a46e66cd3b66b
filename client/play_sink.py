"""Where a player's pictures go besides a window: nowhere, or into a .y4m file; in the size of a display, where one was named."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import av
from av.video.reformatter import Interpolation, VideoReformatter

from client.errors import OutputError
from client.frames import Frame
from client.pipeline import Sink
from client.video import from_av_frame, plane_view
from client.whole_file import landing, partial_beside
from client.y4m import Y4mWriter


class Resizer:
    """A picture to `width` x `height`, bicubic by swscale: planes to planes; time, tags and damage are kept.

    swscale takes chroma as centred: what is left-sited comes out a sixth of a luma sample off at 1.5 times the size.
    """

    def __init__(self, width: int, height: int) -> None:
        self._width, self._height = width, height
        self._scaler = VideoReformatter()
        self._source = av.VideoFrame(width, height, "yuv420p")

    def resize(self, frame: Frame) -> Frame:
        if (frame.width, frame.height) == (self._width, self._height):
            return frame
        if (self._source.width, self._source.height) != (frame.width, frame.height):
            self._source = av.VideoFrame(frame.width, frame.height, "yuv420p")
        for plane, values in zip(self._source.planes, (frame.y, frame.u, frame.v), strict=True):
            plane_view(plane)[:] = values
        resized = self._scaler.reformat(self._source, self._width, self._height, "yuv420p", interpolation=Interpolation.BICUBIC)
        planes = from_av_frame(resized)
        return replace(frame, y=planes.y, u=planes.u, v=planes.v)


class ResizingSink:
    """Hands pictures on in one size."""

    def __init__(self, sink: Sink, width: int, height: int) -> None:
        self._sink, self._resizer = sink, Resizer(width, height)

    def write(self, frame: Frame) -> None:
        self._sink.write(self._resizer.resize(frame))


class Y4mSink:
    """Uncompressed pictures in .y4m, the size of the first; a context manager. Later ones of another size are resized.

    The file appears whole when the block ends, and not at all when an exception ends it. It holds what was shown, one after the other:
    set `period_ns` before the end to say at what rate. Raises OutputError, in one sentence.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        self.path, self.period_ns = path, 1_000_000_000 // 60
        self._force = force
        self._target = landing(path)
        strange = self._target.exists() and not self._target.is_file()
        if os.path.lexists(path) and (not force or strange):
            reason = "it is not a file" if strange else "name another file, or replace it with --force"
            raise OutputError(f"cannot write {path}, which exists: {reason}")
        if not self._target.parent.is_dir():
            raise OutputError(f"cannot write {path}: the folder {self._target.parent} does not exist")
        self._partial = partial_beside(self._target)
        self._file: BinaryIO | None = None
        self._writer: Y4mWriter | None = None
        self._resizer: Resizer | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if self._file is not None and self._writer is not None and kind is None:
                with self._as_sentence():
                    self._file.seek(0)
                    self._writer.header(self._rate())
                    self._file.close()
                    if os.path.lexists(self.path) and not self._force:
                        raise OutputError(f"{self.path} has appeared while it was being made: name another file, or use --force")
                    self._partial.replace(self._target)
        finally:
            if self._file is not None:
                with contextlib.suppress(OSError):
                    self._file.close()
            self._partial.unlink(missing_ok=True)

    def write(self, frame: Frame) -> None:
        with self._as_sentence():
            if self._file is None or self._writer is None or self._resizer is None:
                self._file = self._partial.open("xb", buffering=0)
                self._resizer = Resizer(frame.width, frame.height)
                self._writer = Y4mWriter(self._file, frame, self._rate())
            self._writer.picture(self._resizer.resize(frame))

    def _rate(self) -> Fraction:
        return Fraction(1_000_000_000, max(1, self.period_ns))

    @contextlib.contextmanager
    def _as_sentence(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}") from error
