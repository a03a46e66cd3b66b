"""Packets to frames: a packet-wise demuxer and decoder that outlives broken packets."""

from __future__ import annotations

import stat
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self, cast

import av
import numpy as np
from av.buffer import Buffer
from av.codec.context import Flags, ThreadType
from av.container import InputContainer
from av.stream import Disposition
from av.video.plane import VideoPlane
from av.video.stream import VideoStream

from client.chroma import halve_rows, halve_rows_and_columns
from client.errors import InputError
from client.frames import ColourTags, Frame, Plane

MAX_SIDE = 8192
# Containers that hold their streams themselves. Playlists and session descriptions (hls, concat, dash, sdp) name other
# files and addresses, so they are not opened at all.
CONTAINERS = "mov,matroska,avi,mpegts,flv,h264,hevc,m4v,mpeg,mpegvideo,ivf,obu,nut,ogg,asf,yuv4mpegpipe"
FORMATS = ("yuv420p", "yuvj420p", "nv12", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p")
_PROGRESSIVE = (0, 1)  # AVFieldOrder: unknown, progressive


@dataclass(frozen=True, slots=True)
class Decoded:
    """A frame with `time.perf_counter_ns()` of when the decoder was given its packet and of when the frame was there."""

    frame: Frame
    packet_ns: int
    decoded_ns: int


class OpenVideo:
    """The video stream of a container that is open; a context manager, iterated once for its frames in order of presentation.

    Frames come out as 8-bit 4:2:0 (see `from_av_frame`), with sliced threads: nothing waits for a later packet unless the
    stream reorders. A packet that cannot be decoded is counted in `decode_errors` and decoding goes on; from there to the next
    key frame behind it the frames are marked damaged. `announced_frames` is what the container says it shows, and
    `estimated_frames` that or its duration times its frame rate; None where it says neither.

    Once it is closed, asking for more raises ValueError; frames that came out before stay valid.

    Raises InputError, in one sentence that begins with `name`, for what holds no video and for pictures that are not supported:
    interlaced, larger than 8192x8192, or of another pixel format.
    """

    path: Path | None = None  # of what can be opened again

    def __init__(self, name: str, container: InputContainer) -> None:
        self.name = name
        self.decode_errors = 0
        self.broke_off = False  # reading failed before the end, which is counted as well
        self.display_matrix: tuple[int, ...] | None = None  # known with the first frame
        self._container = container
        try:
            self._stream = self._video_stream()
        except BaseException:
            self._container.close()
            raise
        context = self._stream.codec_context
        context.thread_type = ThreadType.SLICE
        # Cropped to the pixel, where FFmpeg would keep columns on the left that are not to be seen; and each picture names its packet.
        context.flags |= Flags.unaligned | Flags.copy_opaque
        if context.name == "libdav1d":  # or pictures wait; the decoders of MPEG-1, 2 and 4 take this flag for a promise of no B-frames
            context.flags |= Flags.low_delay
        context.options = {"max_pixels": str(MAX_SIDE * MAX_SIDE)}
        self.width, self.height = context.width, context.height
        self.time_base = self._stream.time_base or Fraction(1, 90000)
        self.frame_rate = self._stream.guessed_rate or self._stream.average_rate or Fraction(30)
        self.sample_aspect_ratio = self._stream.sample_aspect_ratio or Fraction(1)
        self.announced_frames = self._announced() or None
        self.has_sound = bool(container.streams.audio)
        duration_us = self._container.duration
        self.estimated_frames = self.announced_frames or (round(duration_us * self.frame_rate / 1_000_000) if duration_us else None)
        self._damaged = False
        self._given = self._lost_at = 0  # packets so far, and when one was lost
        self._begun = False
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._closed = True
        self._container.close()

    def __iter__(self) -> Iterator[Decoded]:
        for packet in self.packets():
            yield from self.decode(packet)

    def decode(self, packet: av.Packet[VideoStream]) -> Iterator[Decoded]:
        """The frames that one of `packets` completes."""
        self._check_open()
        packet_ns = time.perf_counter_ns()
        self._given += 1
        packet.opaque = (self._given,)  # a new object each time: PyAV tells them apart by their addresses
        try:
            pictures = packet.decode()
        except av.FFmpegError:
            self.decode_errors += 1
            self.distrust()
            return
        for picture in pictures:
            self._check_open()
            frame = self._frame(picture)
            yield Decoded(frame, packet_ns, time.perf_counter_ns())
            packet_ns = time.perf_counter_ns()  # a second frame of the same packet did not wait while the first was used

    def distrust(self) -> None:
        """A packet was lost: what comes is damaged until a key frame of a later packet; an earlier one may yet wait to be reordered."""
        self._damaged, self._lost_at = True, self._given

    def packets(self) -> Iterator[av.Packet[VideoStream]]:
        """Packets with something in them, then one empty one: it flushes the decoder, and any other would end it early."""
        packets = self._container.demux(self._stream)
        while True:
            self._check_open()
            try:
                packet = next(packets, None)
            except av.FFmpegError:
                self.decode_errors += 1
                self.broke_off = True
                packet = None  # the file cannot be read further: what the decoder still holds comes out
            if packet is None:
                break
            if packet.size:
                yield packet
        flush = cast("av.Packet[VideoStream]", av.Packet())
        flush.stream, flush.time_base = self._stream, self.time_base
        yield flush

    def _check_open(self) -> None:
        if self._closed:  # FFmpeg would read what is freed
            raise ValueError(f"{self.name} was closed: take its frames before that, in the thread that closes it")

    def _frame(self, picture: av.VideoFrame) -> Frame:
        if picture.interlaced_frame:
            raise InputError(f"{self.name} is interlaced, which is not supported: deinterlace it first")
        _check_size(self.name, picture.width, picture.height)
        if not self._begun:  # of later ones too it would make a cycle of references, which keeps pictures until a garbage collection
            self._begun = True
            self.display_matrix = _display_matrix(picture)
        packet = cast("tuple[int] | None", picture.opaque)
        if picture.is_corrupt:
            self._damaged = True
        elif picture.key_frame and (packet is None or packet[0] > self._lost_at):
            self._damaged = False
        return from_av_frame(picture, damaged=self._damaged)

    def _announced(self) -> int:
        """Frames by the container's count; of an .mp4 or .mov those that its edit list leaves, which the count does not know of."""
        counted = self._stream.frames
        if not counted or "mp4" not in self._container.format.name:
            return counted
        return sum(not entry.is_discard for entry in self._stream.index_entries)

    def _video_stream(self) -> VideoStream:
        stream = self._container.streams.best("video")  # not a cover picture where there is a video
        if not isinstance(stream, VideoStream):
            kinds = ", ".join(sorted({stream.type for stream in self._container.streams})) or "no stream"
            raise InputError(f"{self.name} has no video stream ({kinds} only)")
        if stream.disposition & Disposition.attached_pic:
            raise InputError(f"{self.name} has no video stream but a cover picture")
        if stream.codec_context is None:
            raise InputError(f"{self.name} has a video stream of a codec that cannot be decoded")
        context = stream.codec_context
        if not context.width or not context.height:
            raise InputError(f"{self.name} holds no video frame that can be decoded")
        _check_size(self.name, context.width, context.height)
        if context.pix_fmt is not None:
            _check_format(context.pix_fmt)
        if context.field_order not in _PROGRESSIVE:
            raise InputError(f"{self.name} is interlaced, which is not supported: deinterlace it first")
        return stream


class VideoSource(OpenVideo):
    """The video stream of a local file; raises InputError as well for what is none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(str(path), open_local(path))


def open_local(path: Path) -> InputContainer:
    """Open a file, and nothing but that file whatever is written in it; raises InputError."""
    path = Path(path)
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is not a file")
    if status.st_size == 0:
        raise InputError(f"{path} is empty")
    try:
        # The prefix keeps a name with a colon from being read as an address.
        whitelists = {"protocol_whitelist": "file", "format_whitelist": CONTAINERS}
        return av.open(f"file:{path.absolute()}", "r", options=whitelists, metadata_errors="replace")  # old titles are seldom UTF-8
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (av.FFmpegError, UnicodeError) as error:
        raise InputError(f"{path} is not a video file that can be opened: it is cut short, damaged or of another kind") from error


def plane_view(plane: VideoPlane) -> Plane:
    """The picture's own memory as uint8 (height, width); rows are `line_size` bytes apart, nothing is copied."""
    if plane.line_size <= 0:
        raise InputError("pictures that are stored bottom-up are not supported")
    rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]


def from_av_frame(picture: av.VideoFrame, *, damaged: bool = False) -> Frame:
    """An 8-bit PyAV frame as a `Frame`: 4:2:0 over the same memory, 4:2:2 and 4:4:4 with chroma filtered to left-sited 4:2:0.

    The planes are not to be written to. `damaged` is set too when the decoder marked the picture corrupt. Raises InputError for another
    pixel format.
    """
    name = picture.format.name
    _check_format(name)
    y = plane_view(picture.planes[0])
    if name == "nv12":
        interleaved = np.frombuffer(memoryview(picture.planes[1]), np.uint8).reshape(-1, picture.planes[1].line_size)
        rows, columns = -(-picture.height // 2), -(-picture.width // 2)
        u, v = interleaved[:rows, 0 : 2 * columns : 2], interleaved[:rows, 1 : 2 * columns : 2]
    else:
        u, v = plane_view(picture.planes[1]), plane_view(picture.planes[2])
        if name.endswith("422p"):
            u, v = halve_rows(u), halve_rows(v)
        elif name.endswith("444p"):
            u, v = halve_rows_and_columns(u), halve_rows_and_columns(v)
    for plane in (y, u, v):
        plane.setflags(write=False)  # a decoder predicts the pictures to come from this memory
    colour_range = 2 if name.startswith("yuvj") else int(picture.color_range)
    tags = ColourTags(colour_range, int(picture.color_primaries), int(picture.color_trc), int(picture.colorspace))
    return Frame(y, u, v, picture.pts, picture.time_base, tags, damaged or bool(picture.is_corrupt))


def to_av_frame(frame: Frame) -> av.VideoFrame:
    """A PyAV yuv420p frame with a copy of the planes, the time and the colour tags."""
    picture = av.VideoFrame(frame.width, frame.height, "yuv420p")
    for plane, source in zip(picture.planes, (frame.y, frame.u, frame.v), strict=True):
        plane_view(plane)[:] = source
    picture.pts = frame.pts
    if frame.time_base is not None:
        picture.time_base = frame.time_base
    tags = frame.colour
    picture.color_range, picture.color_primaries = tags.range, tags.primaries
    picture.color_trc, picture.colorspace = tags.transfer, tags.matrix
    return picture


def read_frames(path: Path) -> Iterator[Frame]:
    """Every frame of a file's video stream. The planes stay valid as long as the frame is held."""
    with VideoSource(path) as source:
        for decoded in source:
            yield decoded.frame


def _display_matrix(picture: av.VideoFrame) -> tuple[int, ...] | None:
    side_data = cast("Mapping[str, Buffer]", picture.side_data)  # the stub knows of motion vectors only
    matrix = side_data.get("DISPLAYMATRIX")
    return None if matrix is None else tuple(np.frombuffer(memoryview(matrix), np.int32).tolist())


def _check_size(name: str, width: int, height: int) -> None:
    if max(width, height) > MAX_SIDE:
        raise InputError(f"{name} is {width}x{height}: pictures larger than {MAX_SIDE}x{MAX_SIDE} are not supported")


def _check_format(name: str) -> None:
    if name not in FORMATS:
        raise InputError(f"pixel format {name} is not supported: convert the video to 8-bit 4:2:0 (yuv420p) first")
