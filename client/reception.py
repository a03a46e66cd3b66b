"""Datagrams in, access units out, feedback back: the receiver's rules, without a socket and without a clock of its own."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, replace

from aiortc.rtp import RtcpByePacket, RtpPacket, is_rtcp

from client.access_unit import AccessUnit, Assembler
from client.loss import LossRule
from client.reorder import WAIT_NS, ReorderBuffer
from client.rtp import PAYLOAD_TYPE, SEND_TIME_ID, extensions_map, keyframe_request, parse_rtcp, parse_rtp, unwrap

Address = tuple[str, int]

SILENCE_NS = 1_000_000_000  # after which another sender is listened to
KEYFRAME_INTERVAL_NS = 100_000_000  # between two requests: more than a round trip, so that one loss costs one IDR
HEALING_NS = 1_500_000_000  # how long a stream with recovery points is left to heal by itself
_MAX_DROPOUT, _MAX_MISORDER = 3000, 100  # RFC 3550, A.1


@dataclass(slots=True)
class ReceptionCounts:
    """What happened since the beginning; `ignored` datagrams came from somebody else or were no RTP of this stream."""

    packets: int = 0
    bytes: int = 0
    lost: int = 0
    late: int = 0
    duplicates: int = 0
    malformed: int = 0
    ignored: int = 0
    units: int = 0
    damaged_units: int = 0
    overflowed_units: int = 0
    senders: int = 0  # more than one: it was started again, or another took its place
    keyframe_requests: int = 0
    span_ns: int = 0  # from the first packet to the newest

    @property
    def kbps(self) -> float:
        """RTP headers included, those of UDP and IP not."""
        return self.bytes * 8e6 / max(1, self.span_ns)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A packet that may be the first of a new stream."""

    address: Address
    packet: RtpPacket
    size: int
    arrived_ns: int


class Reception:
    """Follows one sender: its packets in order, its pictures whole as soon as their marker bit is there, judged by the loss rule.

    It locks to the first address and SSRC that sends two packets in sequence (RFC 3550, A.1), and ignores others until that
    one has said goodbye or been silent for a second. From the same address, two packets in sequence with another SSRC, far away in
    sequence, or behind a goodbye by more than packets overtake each other, are a sender that was started again. Every buffer is
    bounded; nothing that is received raises.

    All times are `time.perf_counter_ns()`, given by the caller.
    """

    def __init__(
        self,
        *,
        wall_offset_ns: int,
        payload_type: int = PAYLOAD_TYPE,
        send_time_id: int | None = SEND_TIME_ID,
        parameters_known: bool = False,
    ) -> None:
        self._counts = ReceptionCounts()
        self.sender: Address | None = None
        self.ended = False  # the sender said goodbye
        self._ended_ns = 0  # when it did
        self.heard_ns = 0  # when the sender's newest packet came
        self._begun_ns = 0  # when the first packet of all came
        self._payload_type, self._extensions = payload_type, extensions_map(send_time_id)
        self._own_ssrc = secrets.randbits(32)
        self._ssrc: int | None = None
        self._newest = 0  # sequence number, unwrapped
        self._candidate: _Candidate | None = None
        self._order: ReorderBuffer[tuple[RtpPacket, int]] = ReorderBuffer(0)
        self._assembler = Assembler(wall_offset_ns, parameters_known)
        self._rule = LossRule(parameters_known)
        self._damaged_since_ns: int | None = None
        self._keyframe_wanted = False
        self._requested_ns: int | None = None

    @property
    def counts(self) -> ReceptionCounts:
        """A copy, as of now."""
        order = self._order
        return replace(
            self._counts,
            lost=self._counts.lost + order.lost,
            late=self._counts.late + order.late,
            duplicates=self._counts.duplicates + order.duplicates,
            malformed=self._assembler.malformed,
        )

    def take(self, datagram: bytes, address: Address, now_ns: int) -> list[AccessUnit]:
        """What a datagram completes; anything may be in it."""
        if is_rtcp(datagram):
            return self._take_rtcp(datagram, address, now_ns)
        packet = parse_rtp(datagram, self._extensions)
        if packet is None:
            self._counts.ignored += 1
            return []
        number = unwrap(packet.sequence_number, self._newest, 16)
        gone = self.ended and now_ns - self._ended_ns > WAIT_NS
        mine = (address, packet.ssrc) == (self.sender, self._ssrc) and not gone and -_MAX_MISORDER < number - self._newest < _MAX_DROPOUT
        if packet.payload_type != self._payload_type:
            if not mine:
                self._counts.ignored += 1
                return []
            packet.payload = b""  # not read, as padding is not, but nor is its number missing: such as of error correction (RFC 5109)
        if mine:
            return self._accept(number, packet, len(datagram), now_ns)
        return self._consider(packet, len(datagram), address, now_ns)

    def release(self, now_ns: int) -> list[AccessUnit]:
        """What time alone completes: packets that waited long enough for a missing one."""
        return self._assemble(self._order.release(now_ns), now_ns)

    def release_due_ns(self) -> int | None:
        """When `release` should be called if nothing comes before."""
        return self._order.due_ns()

    def lose(self, units: int) -> None:
        """The caller threw away that many units: what follows them is damaged."""
        self._counts.overflowed_units += units
        self._assembler.skip(units)

    def want_keyframe(self) -> None:
        """The decoder cannot go on: ask even where the stream would heal by itself."""
        self._keyframe_wanted = True

    def feedback(self, now_ns: int) -> bytes | None:
        """The RTCP datagram to send to `sender` now, if any: a request for a key frame, at most ten a second."""
        if self._ssrc is None or self.ended or not (self._keyframe_wanted or self._needs_help(now_ns)):
            return None
        if self._requested_ns is not None and now_ns - self._requested_ns < KEYFRAME_INTERVAL_NS:
            return None
        self._requested_ns, self._keyframe_wanted = now_ns, False
        self._counts.keyframe_requests += 1
        return keyframe_request(self._own_ssrc, self._ssrc)

    def _needs_help(self, now_ns: int) -> bool:
        if self._damaged_since_ns is None:
            return False
        return not self._rule.heals or now_ns - self._damaged_since_ns > HEALING_NS

    def _take_rtcp(self, datagram: bytes, address: Address, now_ns: int) -> list[AccessUnit]:
        if address != self.sender:
            self._counts.ignored += 1
        elif any(isinstance(packet, RtcpByePacket) and self._ssrc in packet.sources for packet in parse_rtcp(datagram)):
            self.ended, self._ended_ns = True, now_ns
            # Nothing follows that could fill a gap, or tell that the last picture's end is missing.
            units = self._assemble(self._order.release(now_ns + WAIT_NS), now_ns)
            return units + [self._judged(unit, now_ns) for unit in self._assembler.end()]
        return []

    def _accept(self, number: int, packet: RtpPacket, size: int, now_ns: int) -> list[AccessUnit]:
        if not self._counts.packets:
            self._begun_ns = now_ns
        self._counts.packets += 1
        self._counts.bytes += size
        self._counts.span_ns = now_ns - self._begun_ns
        self.heard_ns = now_ns
        self._newest = max(self._newest, number)
        self._candidate = None
        return self._assemble(self._order.push(number, (packet, now_ns), now_ns), now_ns)

    def _consider(self, packet: RtpPacket, size: int, address: Address, now_ns: int) -> list[AccessUnit]:
        """A packet that is not of the locked stream: two in sequence make a new one, and both are kept."""
        present = self.sender is not None and not self.ended and now_ns - self.heard_ns < SILENCE_NS
        if present and address != self.sender:
            self._counts.ignored += 1
            return []
        before, self._candidate = self._candidate, _Candidate(address, packet, size, now_ns)
        if before is None or before.address != address or before.packet.ssrc != packet.ssrc:
            return []
        first = before.packet.sequence_number
        if packet.sequence_number != (first + 1) & 0xFFFF:
            return []
        self.sender, self._ssrc, self.ended = address, packet.ssrc, False
        self._newest = first
        self._counts = self.counts  # with what the old order counted
        self._order = ReorderBuffer(first)
        self._assembler.restart(before.packet, now_ns)
        self._counts.senders += 1
        units = self._accept(first, before.packet, before.size, before.arrived_ns)
        return units + self._accept(first + 1, packet, size, now_ns)

    def _assemble(self, passed: list[tuple[int, tuple[RtpPacket, int]]], now_ns: int) -> list[AccessUnit]:
        units: list[AccessUnit] = []
        for missing, (packet, arrived_ns) in passed:
            units += [self._judged(unit, now_ns) for unit in self._assembler.add(packet, arrived_ns, missing)]
        return units

    def _judged(self, unit: AccessUnit, now_ns: int) -> AccessUnit:
        damaged = self._rule.admit(unit)
        self._counts.units += 1
        self._counts.damaged_units += damaged
        if not damaged:
            self._damaged_since_ns = None
        elif self._damaged_since_ns is None:
            self._damaged_since_ns = now_ns
        return replace(unit, damaged=damaged)
