"""A stream and its receiver in one simulated time: no sockets, no waiting, the same for the same seed."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from fractions import Fraction

import av
import numpy as np

from client.cloud import CloudEncoder, NetworkSettings
from client.frames import Frame
from client.live import LiveDecoder, Received
from client.reception import Reception
from client.rtp import CLOCK_HZ
from client.sender import Unit
from client.video import from_av_frame
from server.link import Link, Weather
from server.simulation import Simulation

FPS, WIDTH, HEIGHT = 60, 192, 128
CALM = Weather(delay_ns=5_000_000)
IDR = NetworkSettings(2500, FPS, preset="ultrafast", idr_interval_s=60)
INTRA = NetworkSettings(2500, FPS, preset="ultrafast", intra_refresh=True)


@functools.cache
def _texture() -> np.ndarray:
    noise = np.random.default_rng(5).normal(0, 60, (3 * HEIGHT, 3 * WIDTH))
    smooth = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1) + np.roll(noise, (1, 1), (0, 1))) / 2
    return (128 + smooth).clip(16, 235).astype(np.uint8)


def scene(t: int) -> Frame:
    """A texture that pans to and fro, so that motion crosses an intra refresh in both directions, with noise that nothing predicts."""
    texture, across = _texture(), abs(t % 80 - 40) * 3
    y = texture[t % 50 : t % 50 + HEIGHT, across : across + WIDTH].copy()
    y[40:56, 80:112] = np.random.default_rng(t).integers(16, 235, (16, 32), np.uint8)
    return Frame(y, y[::2, ::2].copy(), y[1::2, 1::2].copy())


def planes(frame: Frame) -> bytes:
    return frame.y.tobytes() + frame.u.tobytes() + frame.v.tobytes()


@dataclass
class Shown:
    """Of one picture that came out: its number, whether it was marked damaged, and whether it differs from what was sent."""

    index: int
    damaged: bool
    differs: bool
    latency_ns: int


@dataclass
class Played:
    shown: list[Shown]
    sent: int
    idrs: list[int]
    reception: Reception
    decoder: LiveDecoder
    received: list[Received] = field(repr=False)


class Cloud:
    """Encodes scenes on demand and remembers what a receiver without loss would see."""

    def __init__(self, settings: NetworkSettings) -> None:
        self.sent = 0
        self._encoder = CloudEncoder(settings, WIDTH, HEIGHT)
        self._decoder = av.CodecContext.create("h264", "r")
        self._decoder.thread_count = 1
        self.pictures: list[bytes] = []

    def due_ns(self) -> int:
        return self.sent * 1_000_000_000 // FPS

    def take(self, *, idr: bool = False) -> Unit:
        data = b"".join(self._encoder.encode(scene(self.sent), idr=idr))
        packet = av.Packet(data)
        packet.pts, packet.time_base = self.sent, Fraction(1, FPS)
        self.pictures += [planes(from_av_frame(picture)) for picture in self._decoder.decode(packet)]
        self.sent += 1
        assert len(self.pictures) == self.sent
        return Unit(data, (self.sent - 1) * CLOCK_HZ // FPS)


class Holes:
    """A link that loses certain packets, each named by its picture and its number in it, before another has its turn."""

    def __init__(self, link: Link, drop: set[tuple[int, int]], join: int) -> None:
        self._link, self._drop, self._join = link, drop, join
        self._index, self._number = -1, 0

    def carry(self, size: int, now_ns: int) -> list[int]:
        index = round(now_ns * FPS / 1e9)
        self._index, self._number = index, self._number + 1 if index == self._index else 0
        return [] if index < self._join or (index, self._number) in self._drop else self._link.carry(size, now_ns)


def play(
    settings: NetworkSettings, forth: Weather, *, seed: int = 1, frames: int = 150, drop: set[tuple[int, int]] | None = None, join: int = 0
) -> Played:
    """Stream `frames` scenes through a link, requests going back in 5 ms; `drop` are (picture, packet) that are lost besides.

    With `join` the receiver hears nothing of that many first pictures.
    """
    cloud = Cloud(settings)
    simulation = Simulation(cloud, Holes(Link(forth, seed), drop or set(), join), Link(CALM, seed + 1))
    arrivals = list(simulation.run(frames))
    shown = []
    for arrival in arrivals:
        frame, sent_ns = arrival.received.frame, arrival.received.unit.sent_ns
        assert sent_ns is not None and arrival.index == round(sent_ns * FPS / 1e9)
        shown.append(Shown(arrival.index, frame.damaged, planes(frame) != cloud.pictures[arrival.index], arrival.at_ns - sent_ns))
    received = [arrival.received for arrival in arrivals]
    return Played(shown, simulation.sent, simulation.requested_idrs, simulation.reception, simulation.decoder, received)
