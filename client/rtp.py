"""RTP and RTCP around aiortc's packets: what may be believed of a datagram, numbers that do not wrap, send times, feedback.

RFC 3550 (RTP), RFC 4585 (PLI), RFC 8285 (header extensions); abs-send-time is
http://www.webrtc.org/experiments/rtp-hdrext/abs-send-time.
"""

from __future__ import annotations

import struct

from aiortc.rtcrtpparameters import RTCRtpHeaderExtensionParameters, RTCRtpParameters
from aiortc.rtp import (
    RTCP_PSFB_PLI,
    AnyRtcpPacket,
    HeaderExtensionsMap,
    RtcpPacket,
    RtcpPsfbPacket,
    RtcpRrPacket,
    RtcpSdesPacket,
    RtcpSourceInfo,
    RtpPacket,
)

CLOCK_HZ = 90_000  # RFC 6184, 8.2.1
PAYLOAD_TYPE = 96
SEND_TIME_ID = 1
SEND_TIME_URI = "http://www.webrtc.org/experiments/rtp-hdrext/abs-send-time"
MAX_DATAGRAM = 65_535
_SEND_TIME_BITS, _SEND_TIME_FRACTION_BITS = 24, 18  # seconds as 6.18 fixed point: wraps after 64 s, steps of 3.8 us
_SDES_CNAME = 1


def extensions_map(send_time_id: int | None) -> HeaderExtensionsMap:
    """Which header extension is abs-send-time; with None, none is."""
    extensions = HeaderExtensionsMap()
    if send_time_id is not None:
        extensions.configure(RTCRtpParameters(headerExtensions=[RTCRtpHeaderExtensionParameters(id=send_time_id, uri=SEND_TIME_URI)]))
    return extensions


def parse_rtp(datagram: bytes, extensions: HeaderExtensionsMap) -> RtpPacket | None:
    """The packet, or None where the datagram is not RTP."""
    try:
        return RtpPacket.parse(datagram, extensions)
    except (ValueError, struct.error):  # struct.error: an extension of a length that its kind does not have
        return None


def parse_rtcp(datagram: bytes) -> list[AnyRtcpPacket]:
    """The packets of a compound, or none of them where the datagram is not RTCP."""
    try:
        return RtcpPacket.parse(datagram)
    except (ValueError, struct.error):
        return []


def unwrap(value: int, near: int, bits: int) -> int:
    """The integer that equals `value` modulo 2**bits and lies nearest to `near`."""
    half = 1 << (bits - 1)
    return near + ((value - near + half) & ((1 << bits) - 1)) - half


def send_time(wall_ns: int) -> int:
    """abs-send-time of a wall clock (`time.time_ns()`): 24 bits. Unix and NTP seconds are equal modulo 64."""
    return ((wall_ns << _SEND_TIME_FRACTION_BITS) // 1_000_000_000) & ((1 << _SEND_TIME_BITS) - 1)


def transit_ns(sent: int, arrived_wall_ns: int) -> int:
    """Nanoseconds from an abs-send-time to an arrival on the same wall clock, in -32 s .. 32 s."""
    ticks = unwrap(send_time(arrived_wall_ns) - sent, 0, _SEND_TIME_BITS)
    return (ticks * 1_000_000_000) >> _SEND_TIME_FRACTION_BITS


def description(ssrc: int) -> bytes:
    """An RTCP SDES with the CNAME, which every compound holds (RFC 3550, 6.1); it names nothing of the machine."""
    return bytes(RtcpSdesPacket([RtcpSourceInfo(ssrc, [(_SDES_CNAME, f"{ssrc:08x}@gamesr".encode())])]))


def keyframe_request(own_ssrc: int, media_ssrc: int) -> bytes:
    """A compound RTCP datagram that ends in a picture loss indication."""
    return bytes(RtcpRrPacket(own_ssrc)) + description(own_ssrc) + bytes(RtcpPsfbPacket(RTCP_PSFB_PLI, own_ssrc, media_ssrc))


def asks_for_keyframe(datagram: bytes, media_ssrc: int) -> bool:
    """Whether a datagram holds a picture loss indication about `media_ssrc`."""
    return any(
        isinstance(packet, RtcpPsfbPacket) and packet.fmt == RTCP_PSFB_PLI and packet.media_ssrc == media_ssrc
        for packet in parse_rtcp(datagram)
    )
