"""The cloud's end of the stream, for training and measurement: area downscale and low-latency H.264, packet by packet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from fractions import Fraction

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType

from client.errors import InputError
from client.frames import BT709_LIMITED, ColourTags, Frame, Plane
from client.video import from_av_frame, to_av_frame

SLICE_BYTES = 1200  # with IP, UDP, RTP and a header extension below every path's MTU of today


@dataclass(frozen=True)
class CloudSettings:
    """How a cloud-gaming server encodes: x264 zerolatency, one reference, an IDR every second, a VBV of a few frames."""

    bitrate_kbps: int
    fps: int
    preset: str = "veryfast"
    vbv_frames: int = 4
    threads: int = 1

    def x264_params(self) -> str:
        vbv_kbit = max(1, self.bitrate_kbps * self.vbv_frames // self.fps)
        return (
            f"bitrate={self.bitrate_kbps}:vbv-maxrate={self.bitrate_kbps}:vbv-bufsize={vbv_kbit}:keyint={self.fps}:min-keyint={self.fps}"
            f":scenecut=0:bframes=0:ref=1:sliced-threads=0:threads={self.threads}:lookahead-threads=1"
        )

    def record(self) -> dict[str, object]:
        """Every setting, for the card or store beside a figure."""
        return {**asdict(self), "codec": "libx264", "tune": "zerolatency", "x264_params": self.x264_params()}


def area_downscale(frame: Frame, scale: int) -> Frame:
    """Downscale by an integer: luma by the mean of scale x scale pixels, chroma by a box centred on its left-sited position.

    Averaging chroma in its own scale x scale cells would move colours right by (scale - 1) / (2 * scale) of an output
    chroma sample. Height and width must be multiples of 2 * scale; raises ValueError otherwise.
    """
    if frame.height % (2 * scale) or frame.width % (2 * scale):
        raise ValueError(f"{frame.width}x{frame.height} is not a multiple of {2 * scale}")
    return Frame(
        _luma_mean(frame.y, scale), _chroma_mean(frame.u, scale), _chroma_mean(frame.v, scale), frame.pts, frame.time_base, frame.colour
    )


def area_scale(name: str, size: tuple[int, int], height: int) -> int:
    """By which pictures of `size` (width, height) are downscaled to `height`; raises InputError, about `name`, where that is not even."""
    if size[0] % 2 or size[1] % 2:
        even = ":".join(str(side - side % 2) for side in size)
        raise InputError(
            f"{name} is {size[0]}x{size[1]}, and H.264 needs even sides: crop it first, with ffmpeg -i INPUT -vf crop={even} OUTPUT"
        )
    scale, rest = divmod(size[1], height)
    if rest or not scale or size[1] % (2 * scale) or size[0] % (2 * scale):
        raise InputError(f"{name} is {size[0]}x{size[1]}, which cannot be reduced to a height of {height} evenly")
    return scale


def _luma_mean(plane: Plane, scale: int) -> Plane:
    height, width = plane.shape
    total_type = np.uint16 if scale <= 16 else np.uint32  # the narrow one holds 257 samples, and is twice as fast
    total = plane.reshape(height // scale, scale, width).sum(1, dtype=total_type)
    return _round_divide(total.reshape(height // scale, width // scale, scale).sum(2, dtype=total_type), scale * scale)


def _chroma_mean(plane: Plane, scale: int) -> Plane:
    """Output column j is centred on luma column 2 * scale * j + (scale - 1) / 2, that is chroma column scale * j + (scale - 1) / 4."""
    height, width = plane.shape
    rows = plane.reshape(height // scale, scale, width).sum(1, dtype=np.uint32)
    left = (scale - 1) / 4 - scale / 2  # of the box, from the middle of chroma column scale * j
    taps = [(k, min(k + 0.5, left + scale) - max(k - 0.5, left)) for k in range(-scale, scale + 1)]
    taps = [(k, round(8 * weight)) for k, weight in taps if weight > 0]  # multiples of 1/8 for every whole scale up to 4
    padded = np.pad(rows, ((0, 0), (scale, scale)), mode="edge")
    total = sum(padded[:, scale + k : scale + k + width : scale] * weight for k, weight in taps)
    return _round_divide(np.asarray(total), 8 * scale * scale)


def _round_divide(total: np.ndarray, count: int) -> Plane:
    return ((total + count // 2) // count).astype(np.uint8)


@dataclass(frozen=True)
class NetworkSettings(CloudSettings):
    """How it encodes for a network that loses: no frame larger than its share of the bitrate, every slice in one packet.

    With `intra_refresh` a column of intra blocks wanders over the picture twice a second, announced by recovery points;
    without it there is an IDR every `idr_interval_s` seconds. Either way an IDR comes when it is asked for.
    """

    vbv_frames: int = 1
    intra_refresh: bool = False
    idr_interval_s: int = 4

    def x264_params(self) -> str:
        keyint = max(2, self.fps // 2) if self.intra_refresh else self.fps * self.idr_interval_s
        # The last of two equal keys counts. slice-max-size has no effect with sliced threads.
        return f"{super().x264_params()}:keyint={keyint}:min-keyint=1:slice-max-size={SLICE_BYTES}:intra-refresh={int(self.intra_refresh)}"


class CloudEncoder:
    """Frames in, H.264 packets out; nothing is held back (zerolatency, no B-frames)."""

    def __init__(self, settings: CloudSettings, width: int, height: int, colour: ColourTags = BT709_LIMITED) -> None:
        context = av.CodecContext.create("libx264", "w")
        assert isinstance(context, VideoCodecContext)
        context.width, context.height, context.pix_fmt = width, height, "yuv420p"
        context.time_base = Fraction(1, settings.fps)
        context.framerate = Fraction(settings.fps)
        context.color_range, context.colorspace = colour.range, colour.matrix
        context.color_primaries, context.color_trc = colour.primaries, colour.transfer
        context.options = {
            "preset": settings.preset,
            "tune": "zerolatency",
            "forced-idr": "1",
            "x264-params": settings.x264_params(),
        }
        self._context = context
        self._index = 0

    def encode(self, frame: Frame, *, idr: bool = False) -> list[bytes]:
        picture = to_av_frame(frame)
        if idr:
            picture.pict_type = PictureType.I
        picture.pts, picture.time_base = self._index, self._context.time_base
        self._index += 1
        return [bytes(packet) for packet in self._context.encode(picture)]

    def flush(self) -> list[bytes]:
        return [bytes(packet) for packet in self._context.encode(None)]


def through_codec(frames: Iterable[Frame], settings: CloudSettings) -> Iterator[Frame]:
    """What a client sees of these frames: each one encoded, decoded and handed on before the next is read."""
    encoder: CloudEncoder | None = None
    decoder = av.CodecContext.create("h264", "r")
    decoder.thread_count = 1
    for frame in frames:
        encoder = encoder or CloudEncoder(settings, frame.width, frame.height)
        for packet in encoder.encode(frame):
            yield from (from_av_frame(picture) for picture in decoder.decode(av.Packet(packet)))
    for packet in encoder.flush() if encoder else []:
        yield from (from_av_frame(picture) for picture in decoder.decode(av.Packet(packet)))
    yield from (from_av_frame(picture) for picture in decoder.decode(None))
