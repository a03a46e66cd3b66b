"""A stream and its receiver in one simulated time: no sockets, no waiting, the same for the same seed."""

from __future__ import annotations

import functools
import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction

import av
import numpy as np

from client.cloud import CloudEncoder, NetworkSettings
from client.frames import Frame
from client.live import LiveDecoder, Received
from client.reception import Address, Reception
from client.rtp import CLOCK_HZ, asks_for_keyframe
from client.sender import RtpStream, Unit
from client.video import from_av_frame
from tests.lossy import Link, Weather

FPS, WIDTH, HEIGHT = 60, 192, 128
SENDER: Address = ("127.0.0.1", 40000)
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
        self.idrs: list[int] = []
        self._encoder = CloudEncoder(settings, WIDTH, HEIGHT)
        self._decoder = av.CodecContext.create("h264", "r")
        self._decoder.thread_count = 1
        self.pictures: list[bytes] = []

    def unit(self, *, idr: bool = False) -> Unit:
        data = b"".join(self._encoder.encode(scene(self.sent), idr=idr))
        if idr:
            self.idrs.append(self.sent)
        packet = av.Packet(data)
        packet.pts, packet.time_base = self.sent, Fraction(1, FPS)
        self.pictures += [planes(from_av_frame(picture)) for picture in self._decoder.decode(packet)]
        self.sent += 1
        assert len(self.pictures) == self.sent
        return Unit(data, (self.sent - 1) * CLOCK_HZ // FPS)


def play(
    settings: NetworkSettings, forth: Weather, *, seed: int = 1, frames: int = 150, drop: set[tuple[int, int]] | None = None, join: int = 0
) -> Played:
    """Stream `frames` scenes through a link, requests going back in 5 ms; `drop` are (picture, packet) that are lost besides.

    With `join` the receiver hears nothing of that many first pictures.
    """
    cloud, stream, reception, decoder = Cloud(settings), RtpStream(), Reception(wall_offset_ns=0), LiveDecoder()
    there, back = Link(forth, seed), Link(CALM, seed + 1)
    numbers = itertools.count()
    events: list[tuple[int, int, str, bytes]] = [(index * 1_000_000_000 // FPS, next(numbers), "picture", b"") for index in range(frames)]
    heapq.heapify(events)
    asked, received, now_ns = False, [], 0

    def take(datagram: bytes | None) -> Iterator[tuple[int, Received]]:
        units = [] if datagram is None else reception.take(datagram, SENDER, now_ns)
        for unit in units + reception.release(now_ns):
            errors = decoder.decode_errors
            for item in decoder.decode(unit):
                yield now_ns, item
            if decoder.stuck or decoder.decode_errors > errors:
                reception.want_keyframe()
        if (feedback := reception.feedback(now_ns)) is not None:
            for at in back.carry(len(feedback), now_ns):
                heapq.heappush(events, (at, next(numbers), "feedback", feedback))

    while events or reception.release_due_ns() is not None:
        due_ns = reception.release_due_ns()
        if due_ns is not None and (not events or due_ns <= events[0][0]):
            now_ns = max(now_ns, due_ns)
            received += take(None)
            continue
        now_ns, _, kind, datagram = heapq.heappop(events)
        if kind == "picture":
            index = cloud.sent
            for number, sent in enumerate(stream.datagrams(cloud.unit(idr=asked), lambda now=now_ns: now)):
                if index >= join and (index, number) not in (drop or ()):
                    for at in there.carry(len(sent), now_ns):
                        heapq.heappush(events, (at, next(numbers), "datagram", sent))
            asked = False
        elif kind == "feedback":
            asked |= asks_for_keyframe(datagram, stream.ssrc)
        else:
            received += take(datagram)

    shown = []
    for at_ns, item in received:
        assert item.unit.sent_ns is not None
        index = round(item.unit.sent_ns * FPS / 1e9)
        shown.append(Shown(index, item.frame.damaged, planes(item.frame) != cloud.pictures[index], at_ns - item.unit.sent_ns))
    return Played(shown, cloud.sent, cloud.idrs, reception, decoder, [item for _, item in received])
