"""A stream, the network and its receiver in one simulated time: no sockets, no waiting, the same every time."""

from __future__ import annotations

import heapq
import itertools
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from client.live import LiveDecoder, Received
from client.reception import Address, Reception
from client.rtp import asks_for_keyframe
from client.sender import IDR_INTERVAL_NS, RtpStream, Unit

SENDER: Address = ("127.0.0.1", 40000)
_STEP_NS = 100_000  # abs-send-time counts in 3.8 us, and pictures are milliseconds apart


class Source(Protocol):
    """What is streamed: `client.sender.UnitSource` as far as it can make an IDR whenever it is asked for."""

    def due_ns(self) -> int | None: ...

    def take(self, *, idr: bool) -> Unit: ...


class Carrier(Protocol):
    """One direction of a network: `server.link.Link`."""

    def carry(self, size: int, now_ns: int) -> list[int]:
        """Times of delivery of a datagram of `size` bytes that goes in now: none where it is lost."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A decoded picture: which of those that were sent it is, and when it was there."""

    index: int
    at_ns: int
    received: Received


class _Event(Enum):
    PICTURE = auto()
    DATAGRAM = auto()
    FEEDBACK = auto()


class Simulation:
    """`gamesr-stream` and the receiver of `gamesr-play` with a network between them, without their sockets.

    Every picture is made and sent when it is due, and an IDR at most every 200 ms when asked for, as `client.sender.stream` does;
    requests go back through `back`. Sending, receiving and decoding take no time: what takes time is the network.
    `requested_idrs` are the numbers of the pictures that became one.
    """

    def __init__(self, source: Source, forth: Carrier, back: Carrier) -> None:
        self.sent = 0
        self.requested_idrs: list[int] = []
        self.reception, self.decoder = Reception(wall_offset_ns=0), LiveDecoder()
        self._source, self._forth, self._back = source, forth, back
        self._stream = RtpStream()
        self._sent_ns: list[int] = []
        self._asked = False
        self._events: list[tuple[int, int, _Event, bytes]] = []
        self._numbers = itertools.count()

    def run(self, pictures: int) -> Iterator[Arrival]:
        """Send so many pictures, or what the source has; yield each that comes out, until nothing more is on its way."""
        self._schedule(pictures)
        now_ns = 0
        while True:
            due_ns = self.reception.release_due_ns()
            if due_ns is not None and (not self._events or due_ns <= self._events[0][0]):
                now_ns = max(now_ns, due_ns)
                yield from self._receive(None, now_ns)
                continue
            if not self._events:
                return
            now_ns, _, event, datagram = heapq.heappop(self._events)
            if event is _Event.PICTURE:
                self._send(now_ns)
                self._schedule(pictures)
            elif event is _Event.FEEDBACK:
                self._asked |= asks_for_keyframe(datagram, self._stream.ssrc)
            else:
                yield from self._receive(datagram, now_ns)

    def _schedule(self, pictures: int) -> None:
        due_ns = self._source.due_ns()
        if due_ns is not None and self.sent < pictures:
            self._push(due_ns, _Event.PICTURE, b"")

    def _push(self, at_ns: int, event: _Event, datagram: bytes) -> None:
        heapq.heappush(self._events, (at_ns, next(self._numbers), event, datagram))

    def _send(self, now_ns: int) -> None:
        answered = self.requested_idrs
        recent = bool(answered) and now_ns - self._sent_ns[answered[-1]] < IDR_INTERVAL_NS
        idr = self._asked and not recent
        if idr:
            self._asked = False
            answered.append(self.sent)
        self._sent_ns.append(now_ns)
        self.sent += 1
        for datagram in self._stream.datagrams(self._source.take(idr=idr), lambda: now_ns):
            for at_ns in self._forth.carry(len(datagram), now_ns):
                self._push(at_ns, _Event.DATAGRAM, datagram)

    def _receive(self, datagram: bytes | None, now_ns: int) -> Iterator[Arrival]:
        units = [] if datagram is None else self.reception.take(datagram, SENDER, now_ns)
        for unit in units + self.reception.release(now_ns):
            errors = self.decoder.decode_errors
            for received in self.decoder.decode(unit):
                sent_ns = received.unit.sent_ns
                assert sent_ns is not None  # our own stream says so
                yield Arrival(bisect_right(self._sent_ns, sent_ns + _STEP_NS) - 1, now_ns, received)
            if self.decoder.stuck or self.decoder.decode_errors > errors:
                self.reception.want_keyframe()
        feedback = self.reception.feedback(now_ns)
        if feedback is not None:
            for at_ns in self._back.carry(len(feedback), now_ns):
                self._push(at_ns, _Event.FEEDBACK, feedback)
