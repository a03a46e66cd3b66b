"""Access units to frames: the decoder of a live stream, which outlives what a network does to it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction

import av
from av.codec.context import Flags
from av.stream import Stream
from av.video.codeccontext import VideoCodecContext

from client.access_unit import AccessUnit
from client.errors import InputError
from client.loss import LossRule
from client.receiver import RtpReceiver
from client.rtp import CLOCK_HZ
from client.upscaler import MAX_OUTPUT_PIXELS
from client.video import Decoded, from_av_frame

_TIME_BASE = Fraction(1, CLOCK_HZ)
MAX_PIXELS = MAX_OUTPUT_PIXELS // 4  # no scale is smaller than 2: what is larger could not be shown
_UNITS_KEPT = 32  # twice what H.264 may reorder
_IDLE_S = 0.01


@dataclass(frozen=True, slots=True)
class Received(Decoded):
    """A decoded frame with the access unit that it came in; `pts` is the unit's timestamp, `packet_ns` when it was decoded."""

    unit: AccessUnit


class LiveDecoder:
    """Decodes each access unit as it is given; a frame is marked damaged as the loss rule says, or as the decoder itself does.

    Nothing is decoded before the stream's first IDR or recovery point. What cannot be decoded, or not be shown, is counted in
    `decode_errors`, the reason kept in `refusal`, and taken for a loss. `stuck` says that pictures no longer come out: libavcodec
    holds them back when whole frames are lost just where frame_num wraps, until an IDR comes. `without_start` says that the present
    sender has sent something, but no IDR or recovery point to begin with.
    """

    def __init__(self, parameter_sets: bytes = b"") -> None:
        self.decode_errors = 0
        self.refusal: str | None = None
        self.stuck = self.without_start = False
        self._parameter_sets = parameter_sets
        self._rule = LossRule(bool(parameter_sets))
        self._context = _open_decoder()
        self._fresh = True
        self._waiting: dict[int, tuple[AccessUnit, bool]] = {}
        self._delay: int | None = None  # units that wait after a picture came out: the stream's own reordering

    def decode(self, unit: AccessUnit) -> list[Received]:
        """The frames that this unit completes: its own, unless the stream reorders; of a new sender's first, also what the old one left."""
        left = self.flush() if unit.restarted else []
        return left + self._decode(unit)

    def flush(self) -> list[Received]:
        """What a stream that reorders has left at its end; what follows can only begin with an IDR, or is damaged."""
        left = self._frames(None) if self._waiting else []
        self._context, self._fresh, self._delay = _open_decoder(), True, None
        self._waiting.clear()
        self._rule.distrust()
        return left

    def _decode(self, unit: AccessUnit) -> list[Received]:
        damaged = self._rule.admit(unit)
        self.without_start = not self._rule.begun
        if self.without_start or not unit.data:
            return []
        packet = av.Packet(self._parameter_sets + unit.data if self._fresh else unit.data)
        self._fresh = False
        packet.pts, packet.time_base = unit.timestamp, _TIME_BASE
        self._waiting[unit.timestamp] = unit, damaged
        if len(self._waiting) > _UNITS_KEPT:
            del self._waiting[next(iter(self._waiting))]
        frames = self._frames(packet)
        self.stuck = not frames and self._delay is not None and len(self._waiting) > self._delay + 1
        return frames

    def _frames(self, packet: av.Packet[Stream] | None) -> list[Received]:
        packet_ns = time.perf_counter_ns()
        try:
            return [received for picture in self._context.decode(packet) if (received := self._receive(picture, packet_ns))]
        except (av.FFmpegError, InputError) as error:
            width, height = self._context.width, self._context.height
            too_large = f"pictures of {width}x{height} are larger than can be upscaled"  # libavcodec just calls them invalid
            self._distrust(too_large if width * height > MAX_PIXELS else str(error))
            return []

    def _receive(self, picture: av.VideoFrame, packet_ns: int) -> Received | None:
        decoded_ns = time.perf_counter_ns()
        if picture.interlaced_frame:
            raise InputError("the stream is interlaced, which is not supported")
        if picture.pts not in self._waiting:
            return None
        unit, damaged = self._waiting.pop(picture.pts)
        for timestamp in [timestamp for timestamp in self._waiting if timestamp < picture.pts]:
            del self._waiting[timestamp]  # pictures come in order: these never will
        if self._delay is None:
            self._delay = len(self._waiting)
        if picture.is_corrupt and not damaged:
            self._rule.distrust()
        return Received(from_av_frame(picture, damaged=damaged), packet_ns, decoded_ns, unit)

    def _distrust(self, reason: str) -> None:
        self.decode_errors += 1
        self.refusal = reason
        self._rule.distrust()


def live_frames(receiver: RtpReceiver, decoder: LiveDecoder, idle: Callable[[], None]) -> Iterator[Received]:
    """The frames of a receiver until its sender says goodbye, each as soon as it is decoded.

    `idle` is called while none comes out: also where much comes in, of which nothing can be decoded.
    """
    while not receiver.ended:
        unit, errors = receiver.next_unit(_IDLE_S), decoder.decode_errors
        frames = [] if unit is None else decoder.decode(unit)
        if decoder.decode_errors > errors or (unit is not None and decoder.stuck):
            receiver.request_keyframe()
        if not frames:
            idle()
        yield from frames
    yield from decoder.flush()


def _open_decoder() -> VideoCodecContext:
    """One thread: with sliced threads libavcodec conceals lost slices 1 to 5 dB worse, so what is shown would hang on the machine.

    Pictures that the decoder knows to be wrong come out too: they are marked. Cropping is to the pixel, not to what a processor likes.
    """
    context = av.CodecContext.create("h264", "r")
    assert isinstance(context, VideoCodecContext)
    context.thread_count = 1
    context.flags |= Flags.low_delay | Flags.output_corrupt | Flags.unaligned
    context.options = {"max_pixels": str(MAX_PIXELS)}
    return context
