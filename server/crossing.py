"""A clip that crosses a network that loses: sent, received, upscaled by several on the very same packets, and measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import tee
from pathlib import Path

import av

from client.cloud import CloudEncoder, NetworkSettings, area_downscale, area_scale
from client.errors import InputError
from client.frames import Frame, Plane
from client.pipeline import AnyState, Upscaler, upscale_stream
from client.quality import squared_error
from client.rtp import CLOCK_HZ
from client.sender import Unit
from client.sink import NullSink
from client.video import VideoSource
from server.encoding import clip_frames
from server.link import Link, Weather
from server.simulation import Simulation
from server.viewing import View, Viewing

DELAY_NS = 15_000_000  # each way
KEPT_BYTES = 1 << 30


class Clip:
    """A clip's first frames, as many as a gibibyte holds: their luma to measure against, and reduced by area to be sent.

    `scale` brings them back to full size. Raises InputError for a clip that cannot be read, that changes its size, or whose height
    and width are not whole even multiples of what `height` asks for.
    """

    def __init__(self, path: Path, height: int, frames: int) -> None:
        with VideoSource(path) as source:
            self.fps = max(1, round(source.frame_rate))
            self.scale = area_scale(source.name, (source.width, source.height), height)
            size = source.height, source.width
        kept = max(1, KEPT_BYTES // (size[0] * size[1] * (2 * self.scale**2 + 3) // (2 * self.scale**2)))
        self.name = path.stem
        self.references: list[Plane] = []
        self.reduced: list[Frame] = []
        for frame in clip_frames(path, 1, min(frames, kept)):
            self.references.append(frame.y.copy())
            self.reduced.append(area_downscale(frame, self.scale))

    def at(self, index: int) -> int:
        """Which of the clip's frames picture `index` of a stream is: it runs to and fro, without a cut, for as long as is wanted."""
        turn = max(1, 2 * (len(self.reduced) - 1))
        return min(index % turn, turn - index % turn)


class Shuttle:
    """A `Clip` to and fro as gamesr-stream sends it: encoded picture by picture, each when it is due, an IDR whenever asked for."""

    def __init__(self, clip: Clip, settings: NetworkSettings) -> None:
        first = clip.reduced[0]
        self._clip, self._fps, self._index = clip, settings.fps, 0
        self._encoder = CloudEncoder(settings, first.width, first.height, first.colour)

    def due_ns(self) -> int:
        return self._index * 1_000_000_000 // self._fps

    def take(self, *, idr: bool) -> Unit:
        frame = self._clip.reduced[self._clip.at(self._index)]
        try:
            data = b"".join(self._encoder.encode(frame, idr=idr))
        except av.FFmpegError as error:
            raise InputError(f"x264 cannot encode this clip: {error.strerror}") from error
        unit = Unit(data, self._index * CLOCK_HZ // self._fps)
        self._index += 1
        return unit


def watch(
    clip: Clip, settings: NetworkSettings, weather: Weather, seed: int, pictures: int, upscalers: Mapping[str, Upscaler[AnyState]]
) -> Viewing:
    """Send `pictures` of a clip through a link, and upscale what comes out, the same for every upscaler. Raises GamesrError.

    The first picture always arrives whole: how a stream begins is another question. A picture that is not shown counts as the one
    that is shown instead.
    """
    weather = replace(weather, delay_ns=DELAY_NS, begin_ns=1)
    forth, back = Link(weather, seed), Link(Weather(delay_ns=DELAY_NS), seed)
    simulation = Simulation(Shuttle(clip, settings), forth, back)
    arrivals, *copies = tee(simulation.run(pictures), 1 + len(upscalers))
    ways = [
        upscale_stream((arrival.received for arrival in copy), upscaler, NullSink())
        for copy, upscaler in zip(copies, upscalers.values(), strict=True)
    ]
    errors: dict[str, list[float]] = {name: [] for name in upscalers}
    views: list[View] = []
    shown: list[Plane] = []
    coming = zip(arrivals, *ways, strict=True)
    following = next(coming, None)
    for index in range(pictures):
        view = View.FROZEN
        if following is not None and following[0].index == index:
            arrival, *done = following
            view = View.DAMAGED if arrival.received.frame.damaged else View.CLEAN
            shown = [frame.picture.y for frame in done]
            following = next(coming, None)
        views.append(view)
        reference = clip.references[clip.at(index)]
        for name, plane in zip(upscalers, shown, strict=True):
            errors[name].append(squared_error(reference, plane) / reference.size)
    counts = simulation.reception.counts
    return Viewing(settings.fps, counts.packets + counts.lost, counts.lost, counts.keyframe_requests, views, errors)
