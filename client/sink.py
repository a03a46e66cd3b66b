"""Where upscaled frames go: an H.264 file that appears whole or not at all, or nowhere."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import av
import numpy as np
from av.video.stream import VideoStream

from client.errors import OutputError
from client.frames import Frame
from client.tracks import TrackCopy
from client.video import OpenVideo, to_av_frame
from client.whole_file import landing, partial_beside

MUXERS = {".mp4": "mp4", ".mkv": "matroska"}
# Constant quality far above the stream's own (48 dB from what was computed, on game footage), so that what is seen is the
# network's work and not a second encoder's.
X264_OPTIONS = {"preset": "veryfast", "crf": "12"}
_UNKNOWN = 2  # matrix coefficients of H.273
_SD_LINES = 576  # up to which players take what is untagged for BT.601, and above for BT.709


class NullSink:
    """Takes frames and forgets them."""

    def write(self, frame: Frame) -> None:
        pass


class FileSink:
    """H.264 (x264, crf 12, veryfast) in .mp4 or .mkv; a context manager.

    Written under a temporary name beside `path` and renamed when the block ends, removed when an exception ends it. Keeps
    of `source` the timestamps, colour tags, sample aspect ratio and display matrix, and copies its audio and its subtitles untouched.
    A picture of odd size is padded by one replicated row or column. `notes` says what was changed on the way.

    Raises OutputError, in one sentence, for another suffix, a path that exists (unless `force`) or that is the input
    itself, a folder that is missing or full, audio that the container cannot hold, and a second picture size.
    """

    def __init__(self, path: Path, source: OpenVideo, *, force: bool = False) -> None:
        self.path = path = Path(path)
        self.notes: list[str] = []
        self._source, self._force = source, force
        self._target = landing(path)
        with _as_sentence(path):
            self._check_target()
        self._partial = partial_beside(self._target)
        self._encoding: _Encoding | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None and self._encoding is not None:
                with _as_sentence(self.path):
                    self._encoding.finish()
                    self._publish()
                self.notes += self._encoding.notes()
        finally:
            if self._encoding is not None:
                self._encoding.abandon()
            self._partial.unlink(missing_ok=True)

    def write(self, frame: Frame) -> None:
        """Encode one picture; nothing of it is kept."""
        with _as_sentence(self.path):
            if self._encoding is None:
                self._encoding = _Encoding(self._partial, MUXERS[self.path.suffix.lower()], self._source, frame)
            self._encoding.write(frame)

    def _check_target(self) -> None:
        path, target = self.path, self._target
        if path.suffix.lower() not in MUXERS:
            raise OutputError(f"cannot write {path}: the name must end in {' or '.join(MUXERS)}")
        if not target.parent.is_dir():
            raise OutputError(f"cannot write {path}: the folder {target.parent} does not exist")
        if target.exists():
            if self._source.path is not None and target.samefile(self._source.path):
                raise OutputError(f"cannot write {path}: it is the input")
            if not target.is_file():
                raise OutputError(f"cannot write {path}: it is not a file")
        if os.path.lexists(path) and not self._force:
            raise OutputError(f"{path} exists: name another file, or replace it with --force")

    def _publish(self) -> None:
        if not self._force and os.path.lexists(self.path):
            raise OutputError(f"{self.path} has appeared while it was being made: name another file, or replace it with --force")
        self._partial.replace(self._target)


class _Encoding:
    """The encoder and the container of one output, from its first frame on."""

    def __init__(self, path: Path, muxer: str, source: OpenVideo, first: Frame) -> None:
        self._source_name = source.name
        self._untagged = untagged(source, first)
        self._size = (first.width, first.height)
        self._time_base = first.time_base or source.time_base
        self._frame_ticks = max(1, round(1 / (source.frame_rate * self._time_base)))
        self._last_pts: int | None = None
        self._moved_pts = 0
        ticks = str(self._time_base.denominator)
        # The mp4 header's own clock of 1/1000 s would round the time at which the first frame is shown.
        clocks = {"movie_timescale": ticks, "video_track_timescale": ticks} if muxer == "mp4" else {}
        path.open("xb").close()
        with contextlib.ExitStack() as stack:
            self._container = stack.enter_context(av.open(str(path.absolute()), "w", format=muxer, container_options=clocks))
            self._stream = self._add_video(source, first)
            self._tracks = None if source.path is None else stack.enter_context(contextlib.closing(TrackCopy(source.path, self._container)))
            self._open_files = stack.pop_all()

    def write(self, frame: Frame) -> None:
        if (frame.width, frame.height) != self._size:
            raise OutputError(
                f"the picture of {self._source_name} changes in mid-stream, {self._size[0]}x{self._size[1]} becomes "
                f"{frame.width}x{frame.height} upscaled, which one file cannot hold: cut it there and upscale the parts"
            )
        picture = to_av_frame(_pad_to_even(frame))
        picture.pts, picture.time_base = self._next_pts(frame.pts), self._time_base
        self._container.mux(self._stream.encode(picture))
        if self._tracks:
            self._tracks.copy_until(picture.pts * self._time_base)

    def finish(self) -> None:
        self._container.mux(self._stream.encode(None))
        if self._tracks:
            self._tracks.copy_until(None)
        self._open_files.close()

    def abandon(self) -> None:
        """Let go of the files; what a failed output still wants to write no longer matters. Harmless after `finish`."""
        with contextlib.suppress(OSError, av.FFmpegError):
            self._open_files.close()

    def notes(self) -> list[str]:
        width, height = self._size
        notes = list(self._untagged)
        if width % 2 or height % 2:
            notes.append(
                f"the {width}x{height} picture is padded to {width + width % 2}x{height + height % 2}: H.264 4:2:0 holds even sizes only"
            )
        if self._moved_pts:
            notes.append(f"{self._moved_pts} frames had no timestamp or one that went back: theirs follow from the frame rate")
        return notes + (self._tracks.notes() if self._tracks else ["of a pipe the picture alone is written: no sound, no subtitles"])

    def _add_video(self, source: OpenVideo, first: Frame) -> VideoStream:
        stream = self._container.add_stream("libx264", rate=source.frame_rate, options=dict(X264_OPTIONS))
        context, tags = stream.codec_context, first.colour
        context.width, context.height = (side + side % 2 for side in self._size)
        context.pix_fmt = "yuv420p"
        context.time_base = self._time_base
        context.sample_aspect_ratio = source.sample_aspect_ratio
        context.color_range, context.color_primaries = tags.range, tags.primaries
        context.color_trc, context.colorspace = tags.transfer, tags.matrix
        stream.set_display_matrix(source.display_matrix)
        return stream

    def _next_pts(self, pts: int | None) -> int:
        last = self._last_pts
        if pts is None or (last is not None and pts <= last):
            self._moved_pts += 1
            pts = 0 if last is None else last + self._frame_ticks
        self._last_pts = pts
        return pts


def untagged(source: OpenVideo, first: Frame) -> list[str]:
    """A note where players would guess other colours for the upscaled picture than for that of the source."""
    if first.colour.matrix != _UNKNOWN or source.height > _SD_LINES or first.height <= _SD_LINES:
        return []
    return [
        f"the input does not say how its colours are coded, and players guess BT.601 up to {_SD_LINES} lines and BT.709 above, so they may "
        "show others now: tag it first, H.264 with ffmpeg -c copy -bsf:v h264_metadata=matrix_coefficients=6 (BT.601)"
    ]


def _pad_to_even(frame: Frame) -> Frame:
    """Luma of even height and width by replicating the last row and column; the chroma planes have that size already."""
    padding = (0, frame.height % 2), (0, frame.width % 2)
    return frame if padding == ((0, 0), (0, 0)) else replace(frame, y=np.pad(frame.y, padding, mode="edge"))


@contextlib.contextmanager
def _as_sentence(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, av.FFmpegError) as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
