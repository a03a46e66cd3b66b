"""The cloud's end of the wire: access units as RTP, paced in real time, and an ear for requests of key frames."""

from __future__ import annotations

import secrets
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from types import TracebackType
from typing import Protocol, Self

import av
from aiortc.clock import current_ntp_time
from aiortc.codecs.h264 import H264Encoder
from aiortc.rtp import HeaderExtensions, RtcpByePacket, RtcpRrPacket, RtcpSenderInfo, RtcpSrPacket, RtpPacket

from client.errors import InputError, OutputError
from client.rtp import CLOCK_HZ, MAX_DATAGRAM, PAYLOAD_TYPE, SEND_TIME_ID, asks_for_keyframe, description, extensions_map, send_time

IDR_INTERVAL_NS = 200_000_000  # between two that were asked for: requests that cross an IDR on its way do not bring another
_REPORT_INTERVAL_NS = 1_000_000_000
_SOCKET_BYTES = 4 << 20
_VIDEO_TIME_BASE = Fraction(1, CLOCK_HZ)


@dataclass(frozen=True, slots=True)
class Unit:
    """One encoded picture: Annex B bytes, and its time of presentation in 1/90000 s from the beginning."""

    data: bytes
    timestamp: int


class UnitSource(Protocol):
    """What is streamed: a picture at a time, made when it is due."""

    answers_requests: bool

    def parameter_sets(self) -> list[bytes]:
        """SPS and PPS of the stream, as NAL units without start codes."""

    def due_ns(self) -> int | None:
        """When the next unit is due, from the beginning; None at the end."""

    def take(self, *, idr: bool) -> Unit:
        """The next unit; with `idr`, an IDR if the source can make one."""


@dataclass(frozen=True, slots=True)
class Sent:
    """A unit that was sent: its bytes on the wire, its packets, and how late it was."""

    bytes: int
    packets: int
    late_ns: int


class RtpStream:
    """Access units to datagrams: RFC 3550 and RFC 6184 (single NAL units, STAP-A, FU-A, the marker bit on a picture's last packet).

    SSRC, first sequence number and first timestamp are random; every packet carries abs-send-time.
    """

    def __init__(self) -> None:
        self.ssrc = secrets.randbits(32)
        self._sequence, self._first_timestamp = secrets.randbits(16), secrets.randbits(32)
        self._newest_timestamp = self._first_timestamp
        self._extensions = extensions_map(SEND_TIME_ID)
        self._packets = self._octets = 0

    def datagrams(self, unit: Unit, wall_clock_ns: Callable[[], int]) -> Iterator[bytes]:
        """The packets of a unit, each made when it is asked for, so that it carries the time at which it is sent."""
        self._newest_timestamp = (self._first_timestamp + unit.timestamp) & 0xFFFFFFFF
        payloads = packetise(unit.data)
        for index, payload in enumerate(payloads):
            last = index == len(payloads) - 1
            packet = RtpPacket(PAYLOAD_TYPE, int(last), self._sequence, self._newest_timestamp, self.ssrc, payload)
            packet.extensions = HeaderExtensions(abs_send_time=send_time(wall_clock_ns()))
            self._sequence = (self._sequence + 1) & 0xFFFF
            self._packets = (self._packets + 1) & 0xFFFFFFFF
            self._octets = (self._octets + len(payload)) & 0xFFFFFFFF
            yield packet.serialize(self._extensions)

    def report(self) -> bytes:
        """A sender report about the newest unit."""
        info = RtcpSenderInfo(current_ntp_time(), self._newest_timestamp, self._packets, self._octets)
        return bytes(RtcpSrPacket(self.ssrc, info)) + description(self.ssrc)

    def goodbye(self) -> bytes:
        return bytes(RtcpRrPacket(self.ssrc)) + description(self.ssrc) + bytes(RtcpByePacket([self.ssrc]))


class RtpSender:
    """Sends access units to one receiver and reads its RTCP on the same socket; a context manager.

    A sender report goes out once a second, a BYE at the end. Raises InputError where the host has no address, OutputError where
    packets cannot be sent.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            family, kind, protocol, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
        except (OSError, UnicodeError) as error:
            raise InputError(
                f"{host} port {port} is no address to send to: {getattr(error, 'strerror', 'it is no name of a host')}"
            ) from error
        self._target = target
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BYTES)
        self.requests = 0
        self._stream = RtpStream()
        self._reported_ns: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None or kind is KeyboardInterrupt:
                self._send(self._stream.goodbye())
        finally:
            self._socket.close()

    @property
    def target(self) -> tuple[str, int]:
        """The receiver's IP address and port."""
        return str(self._target[0]), int(self._target[1])

    def send(self, unit: Unit) -> tuple[int, int]:
        """Send one access unit, its packets back to back; returns their number and bytes."""
        sizes = [self._send(datagram) for datagram in self._stream.datagrams(unit, time.time_ns)]
        now_ns = time.perf_counter_ns()
        if self._reported_ns is None or now_ns - self._reported_ns >= _REPORT_INTERVAL_NS:
            self._reported_ns = now_ns
            self._send(self._stream.report())
        return len(sizes), sum(sizes)

    def listen(self, until_ns: int) -> bool:
        """Wait until `until_ns` of `time.perf_counter_ns()`; whether the receiver asked for a key frame meanwhile."""
        asked = False
        while True:
            self._socket.settimeout(max(0.0, (until_ns - time.perf_counter_ns()) / 1e9))  # 0: only what is there already
            try:
                datagram, address = self._socket.recvfrom(MAX_DATAGRAM)
            except (TimeoutError, BlockingIOError):
                return asked
            except OSError:
                continue  # an error that somebody's ICMP left on the socket
            if address == self._target and asks_for_keyframe(datagram, self._stream.ssrc):
                self.requests += 1
                asked = True

    def _send(self, datagram: bytes) -> int:
        self._socket.settimeout(1.0)
        try:
            return self._socket.sendto(datagram, self._target)
        except ConnectionRefusedError:
            return len(datagram)  # nobody listens yet
        except OSError as error:
            host, port = self.target
            raise OutputError(f"cannot send to {host} port {port}: {error.strerror}") from error


def packetise(data: bytes) -> list[bytes]:
    """The RTP payloads of an Annex B access unit, of at most 1300 bytes."""
    packet = av.Packet(data)
    packet.pts, packet.time_base = 0, _VIDEO_TIME_BASE
    return H264Encoder().pack(packet)[0]


def stream(source: UnitSource, sender: RtpSender) -> Iterator[Sent]:
    """Send every unit when it is due, and yield after each.

    A source that is late by more than the time between two units is not hurried: the schedule moves, so that the stream slows
    down instead of coming in bursts.
    """
    begin_ns = time.perf_counter_ns()
    wanted, answered_ns, before_ns = False, 0, 0
    while (due_ns := source.due_ns()) is not None:
        wanted |= sender.listen(begin_ns + due_ns)
        now_ns = time.perf_counter_ns()
        late_ns = now_ns - begin_ns - due_ns
        if late_ns > due_ns - before_ns > 0:
            begin_ns += late_ns
        before_ns = due_ns
        idr = wanted and source.answers_requests and now_ns - answered_ns >= IDR_INTERVAL_NS
        if idr:
            wanted, answered_ns = False, now_ns
        packets, sent = sender.send(source.take(idr=idr))
        yield Sent(sent, packets, late_ns)
