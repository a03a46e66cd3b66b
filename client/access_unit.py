"""RTP payloads to access units: the H.264 of one picture, and what its NAL units say of it (RFC 6184, ITU-T H.264)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from aiortc.codecs.h264 import NAL_TYPE_FU_A, H264PayloadDescriptor
from aiortc.rtp import RtpPacket

from client.rtp import transit_ns, unwrap

MAX_UNIT_BYTES = 8 << 20  # a second of 64 Mbps
MAX_UNIT_PACKETS = 1 << 14
_SLICE, _IDR_SLICE, _SEI, _SPS, _PPS, _DELIMITER = 1, 5, 6, 7, 8, 9  # nal_unit_type, table 7-1
_RECOVERY_POINT = 6  # SEI payloadType, D.1.1
_SEI_BYTES, _SEI_UNITS = 512, 16  # that are looked into: megabytes of them would keep the receiver from its packets for seconds


@dataclass(frozen=True, slots=True)
class Content:
    """What an access unit's NAL units say.

    `recovery_frames` is that of a recovery point SEI: after so many reference pictures the picture is exact whatever was
    there before; None without one, and where the encoder promises only an approximate match.
    """

    idr: bool
    parameters: bool  # holds a sequence parameter set
    headed: bool  # begins with a delimiter, or has a sequence parameter set before any slice: no slice is missing in front
    opens: bool  # has the first slice: nothing but parameter sets can be missing in front
    reference: bool
    recovery_frames: int | None


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """One picture as it arrived: Annex B bytes, when, and what is missing.

    `timestamp` is in 1/90000 s and never wraps. `first_ns` and `last_ns` are `time.perf_counter_ns()` of the arrival of its
    first and last packet; `sent_ns` is when the first of them was sent, on that same clock, and is true only where sender
    and receiver share a wall clock (None without abs-send-time). `lost_packets` are missing between the last packet of the
    unit before and the last of this one. `whole` says that nothing of this unit can be missing, `restarted` that it is the
    first of a sender. `damaged` is what the loss rule says (client.loss), `ready_ns` when a receiver queued it; 0 before.
    """

    data: bytes
    timestamp: int
    first_ns: int
    last_ns: int
    sent_ns: int | None
    packets: int
    lost_packets: int
    whole: bool
    restarted: bool
    content: Content
    damaged: bool = True
    ready_ns: int = 0


class Assembler:
    """Packets in order to access units: one is whole when its marker bit is there, or when the next timestamp begins.

    `wall_offset_ns` is `time.time_ns() - time.perf_counter_ns()`. `parameters_outside` says that the session description
    holds the parameter sets; it is believed until the stream has some. Of a unit larger than 8 MiB the rest is thrown away.
    """

    def __init__(self, wall_offset_ns: int, parameters_outside: bool = False) -> None:
        self.malformed = 0
        self._wall_offset_ns, self._parameters_outside = wall_offset_ns, parameters_outside
        self._timestamp = 0  # of the newest packet, unwrapped
        self._newest_ns: int | None = None
        self._shift = 0  # keeps timestamps rising over a restart
        self._restarted = True
        self._lost = 0  # since the last unit
        self._gap = False  # directly before the next packet that is no padding
        self._unit: _Unit | None = None

    def restart(self, packet: RtpPacket, now_ns: int) -> None:
        """A new sender: its numbers mean nothing beside the old ones; what is unfinished is thrown away."""
        continued = self._timestamp + self._shift
        if self._newest_ns is not None:
            continued += max(1, (now_ns - self._newest_ns) * 9 // 100_000)
        self._timestamp, self._shift = packet.timestamp, continued - packet.timestamp
        self._restarted, self._lost, self._gap, self._unit = True, 0, False, None

    def skip(self, units: int) -> None:
        """Units were thrown away behind this one's back: what comes next follows a loss."""
        self._lost += units

    def add(self, packet: RtpPacket, arrived_ns: int, missing: int) -> Iterator[AccessUnit]:
        """Take the next packet, `missing` ones after the last."""
        self._lost += missing
        self._gap |= missing > 0
        if missing and self._unit is not None:
            self._unit.broken = True
            self._unit.drop_fragment()
        if not packet.payload:  # padding, which keeps a path open
            return
        timestamp = unwrap(packet.timestamp, self._timestamp, 32)
        if self._unit is not None and timestamp != self._timestamp:
            yield self._finish()
        self._timestamp, self._newest_ns = timestamp, arrived_ns
        if self._unit is None:
            sent, sent_ns = packet.extensions.abs_send_time, None
            if sent is not None:
                sent_ns = arrived_ns - transit_ns(sent, arrived_ns + self._wall_offset_ns)
            self._unit = _Unit(arrived_ns, sent_ns, after_gap=self._gap or self._lost > 0 or self._restarted)
        self._gap = False
        unit = self._unit
        unit.last_ns = arrived_ns
        unit.packets += 1
        try:
            unit.add(packet.payload)
        except ValueError:
            self.malformed += 1
            unit.broken = True
        if packet.marker:
            yield self._finish()

    def end(self) -> Iterator[AccessUnit]:
        """Nothing follows: a unit under way lacks its end."""
        if self._unit is not None:
            self._unit.broken = True
            yield self._finish()

    def _finish(self) -> AccessUnit:
        unit = self._unit
        assert unit is not None
        self._unit = None
        if unit.in_fragment:
            unit.broken = True
            unit.drop_fragment()
        data = b"".join(unit.parts)
        content = inspect(data)
        self._parameters_outside &= not content.parameters
        headed = content.headed or (self._parameters_outside and content.opens)
        finished = AccessUnit(
            data=data,
            timestamp=self._timestamp + self._shift,
            first_ns=unit.first_ns,
            last_ns=unit.last_ns,
            sent_ns=unit.sent_ns,
            packets=unit.packets,
            lost_packets=self._lost,
            whole=not unit.broken and (headed or not unit.after_gap),
            restarted=self._restarted,
            content=content,
        )
        self._lost, self._restarted = 0, False
        return finished


class _Unit:
    """An access unit under way."""

    def __init__(self, first_ns: int, sent_ns: int | None, after_gap: bool) -> None:
        self.first_ns = self.last_ns = first_ns
        self.sent_ns, self.after_gap = sent_ns, after_gap
        self.packets = self.bytes = 0
        self.broken = self.in_fragment = False
        self.parts: list[bytes] = []
        self._fragment_begin = 0

    def add(self, payload: bytes) -> None:
        """Raises ValueError for a payload that is not RFC 6184's, or not where it may be."""
        descriptor, data = H264PayloadDescriptor.parse(payload)
        fragmented = payload[0] & 0x1F == NAL_TYPE_FU_A
        if self.in_fragment and (not fragmented or descriptor.first_fragment):
            self.drop_fragment()
            self.broken = True  # the old one never ended
        if fragmented and not descriptor.first_fragment and not self.in_fragment:
            raise ValueError("a fragment of what never began")
        if self.bytes + len(data) > MAX_UNIT_BYTES or self.packets > MAX_UNIT_PACKETS:
            raise ValueError("more than an access unit can be")
        if fragmented and descriptor.first_fragment:
            self._fragment_begin = len(self.parts)
        self.parts.append(data)
        self.bytes += len(data)
        self.in_fragment = fragmented and not payload[1] & 0x40  # the end bit, which aiortc does not tell

    def drop_fragment(self) -> None:
        """Half a NAL unit decodes to rubbish: concealment of all of it is better."""
        if self.in_fragment:
            del self.parts[self._fragment_begin :]
            self.in_fragment = False


def nal_units(data: bytes) -> Iterator[bytes]:
    """The NAL units of an Annex B byte stream (B.1), none of them empty, without start codes and trailing zeros."""
    begin = data.find(b"\0\0\1")
    while begin >= 0:
        end = data.find(b"\0\0\1", begin + 3)
        unit = data[begin + 3 : end if end >= 0 else len(data)].rstrip(b"\0")
        if unit:
            yield unit
        begin = end


def parameter_sets(data: bytes) -> list[bytes]:
    """Sequence, then picture parameter sets of an access unit, each once."""
    units = list(dict.fromkeys(nal_units(data)))
    return [unit for kind in (_SPS, _PPS) for unit in units if unit[0] & 0x1F == kind]


def inspect(data: bytes) -> Content:
    """What the NAL units of an Annex B access unit say."""
    kinds: list[int] = []
    headed = opens = reference = sliced = False
    recovery: int | None = None
    looked_into = 0
    for unit in nal_units(data):
        kind = unit[0] & 0x1F
        kinds.append(kind)
        if kind in (_SLICE, _IDR_SLICE):
            if not sliced:
                opens = unit[1:2] >= b"\x80"  # first_mb_in_slice is 0, coded as one set bit
                headed = kinds[0] == _DELIMITER or _SPS in kinds
            sliced, reference = True, unit[0] & 0x60 != 0
        elif kind == _SEI and recovery is None and looked_into < _SEI_UNITS:
            recovery = recovery_point(unit[1:])
            looked_into += 1
    return Content(_IDR_SLICE in kinds, _SPS in kinds, headed, opens, reference, recovery)


def recovery_point(sei: bytes) -> int | None:
    """recovery_frame_cnt of an SEI's payload (D.1.8) that says exact_match_flag 1 and broken_link_flag 0, else None.

    What lies beyond the first 512 bytes is as if it were not there.
    """
    octets = sei[:_SEI_BYTES].replace(b"\0\0\3", b"\0\0")  # 7.4.1: emulation prevention
    position = 0
    while len(octets) - position > 2:  # the trailing bits are what is left
        kind, position = _extended(octets, position)
        size, position = _extended(octets, position)
        if kind == _RECOVERY_POINT:
            bits = "".join(f"{octet:08b}" for octet in octets[position : position + min(size, 8)])
            zeros = len(bits) - len(bits.lstrip("0"))
            code, flags = bits[zeros : 2 * zeros + 1], bits[2 * zeros + 1 : 2 * zeros + 3]
            return int(code, 2) - 1 if flags == "10" else None
        position += size
    return None


def _extended(octets: bytes, position: int) -> tuple[int, int]:
    """A number coded as a run of 255 and a last octet, and where it ends."""
    value = 0
    while position < len(octets):
        value += octets[position]
        position += 1
        if octets[position - 1] != 255:
            break
    return value, position
