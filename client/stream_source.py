"""What gamesr-stream sends: frames encoded as they are due, or a file that was encoded before."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
from av.bitstream import BitStreamFilterContext
from av.video.stream import VideoStream

from client.access_unit import parameter_sets
from client.cloud import CloudEncoder, CloudSettings, area_downscale, area_scale
from client.errors import InputError
from client.frames import Frame
from client.pace import step_s
from client.rtp import CLOCK_HZ
from client.sender import Unit
from client.video import VideoSource, open_local
from client.whole_frames import check_size

KEPT_BYTES = 512 << 20  # of a clip that is repeated: reducing 1080p costs as much time as encoding the result


class EncodedLive:
    """A clip, downscaled by area to `height` and encoded frame by frame when each is due; an IDR whenever it is asked for.

    Raises InputError for a clip that cannot be read, whose height and width are not whole even multiples, or that changes its size.
    """

    answers_requests = True

    def __init__(self, path: Path, height: int, settings: CloudSettings, *, loop: bool = False) -> None:
        with VideoSource(path) as source:
            scale = area_scale(source.name, (source.width, source.height), height)
            self.width, self.height = source.width // scale, height
        self._path, self._scale, self._settings = path, scale, settings
        self._encoder = CloudEncoder(settings, self.width, self.height)
        self._frames = self._read(loop)
        self._next = next(self._frames, None)
        self._index = 0
        if self._next is None:
            raise InputError(f"no frame of {path} could be decoded")

    def parameter_sets(self) -> list[bytes]:
        assert self._next is not None
        return parameter_sets(b"".join(CloudEncoder(self._settings, self.width, self.height).encode(self._next)))

    def due_ns(self) -> int | None:
        return None if self._next is None else self._index * 1_000_000_000 // self._settings.fps

    def take(self, *, idr: bool) -> Unit:
        assert self._next is not None
        unit = Unit(b"".join(self._encoder.encode(self._next, idr=idr)), self._index * CLOCK_HZ // self._settings.fps)
        self._next = next(self._frames, None)
        self._index += 1
        return unit

    def _read(self, loop: bool) -> Iterator[Frame]:
        kept: list[Frame] | None = [] if loop else None
        for frame in self._reduced():
            if kept is not None:
                kept.append(frame)
                kept = kept if len(kept) * self.width * self.height * 3 // 2 <= KEPT_BYTES else None
            yield frame
        while loop:
            yield from self._reduced() if kept is None else kept

    def _reduced(self) -> Iterator[Frame]:
        with VideoSource(self._path) as source:
            for decoded in source:
                check_size(source, decoded.frame)
                yield area_downscale(decoded.frame, self._scale) if self._scale > 1 else decoded.frame


class EncodedFile:
    """A file's H.264, packet by packet as it was encoded, at its own timestamps or at `fps` pictures a second.

    It cannot make an IDR that it does not have. Packets that are no H.264 are left out, and a file that breaks off ends there.
    Raises InputError for a file that cannot be read or holds no H.264, and with `fps` for one whose pictures are not in order.
    """

    answers_requests = False

    def __init__(self, path: Path, fps: int | None = None, *, loop: bool = False) -> None:
        self._path, self._fps = path, fps
        self._units = self._read(loop)
        self._next = next(self._units, None)
        if self._next is None:
            raise InputError(f"{path} holds no H.264 picture")

    def parameter_sets(self) -> list[bytes]:
        assert self._next is not None
        sets = parameter_sets(self._next[1].data)
        if not sets:
            raise InputError(f"{self._path} does not begin with an IDR and its parameter sets")
        return sets

    def due_ns(self) -> int | None:
        return None if self._next is None else self._next[0]

    def take(self, *, idr: bool) -> Unit:
        assert self._next is not None
        unit = self._next[1]
        self._next = next(self._units, None)
        return unit

    def _read(self, loop: bool) -> Iterator[tuple[int, Unit]]:
        """Each unit with when it is due."""
        begin, again = Fraction(0), True  # of this round, in seconds
        while again:
            end = begin
            for decode_at, show_at, data in self._pictures():
                yield int((begin + decode_at) * 1_000_000_000), Unit(data, int((begin + show_at) * CLOCK_HZ))
                period = begin + decode_at - end
                end = begin + decode_at
            if end == begin:
                return  # one picture or none: nothing to repeat
            begin, again = end + period, loop

    def _pictures(self) -> Iterator[tuple[Fraction, Fraction, bytes]]:
        """Annex B access units with when they are decoded and shown, in seconds from the first one's decoding; neither leaps."""
        with open_local(self._path) as container:
            stream = container.streams.best("video")
            if not isinstance(stream, VideoStream) or stream.codec_context is None or stream.codec_context.name != "h264":
                raise InputError(f"{self._path} holds no H.264: leave out --copy to have it encoded")
            try:
                annex_b = BitStreamFilterContext("h264_mp4toannexb", stream)
            except av.FFmpegError as error:
                raise InputError(f"{self._path} has damaged parameter sets: nothing in it can be decoded") from error
            period = Fraction(1, self._fps) if self._fps else 1 / Fraction(stream.guessed_rate or 30)
            tick = stream.time_base or Fraction(1, CLOCK_HZ)
            decode_at, before = -period, None
            for filtered in _filtered(container.demux(stream), annex_b):
                pts, dts = filtered.pts, filtered.dts
                if self._fps and pts != dts:
                    raise InputError(f"the pictures of {self._path} are not in order (B-frames): leave out --fps")
                decode_at += period if self._fps else step_s(before, dts, tick, period)
                before = dts
                yield decode_at, decode_at + (0 if pts is None or dts is None else (pts - dts) * tick), bytes(filtered)


def _filtered(packets: Iterator[av.Packet[VideoStream]], annex_b: BitStreamFilterContext) -> Iterator[av.Packet[VideoStream]]:
    """What can be read and sent of a file that may be damaged or cut short."""
    while True:
        try:
            packet = next(packets, None)
        except av.FFmpegError:
            return  # it cannot be read further
        if packet is None:
            return
        if packet.size:
            with suppress(av.FFmpegError):
                yield from cast("list[av.Packet[VideoStream]]", annex_b.filter(packet))
