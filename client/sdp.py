"""Session descriptions (RFC 8866) of one H.264 stream: written for any receiver, read from any sender."""

from __future__ import annotations

import base64
import binascii
import ipaddress
from dataclasses import dataclass

from aiortc.sdp import SessionDescription

from client.errors import InputError
from client.rtp import CLOCK_HZ, PAYLOAD_TYPE, SEND_TIME_ID, SEND_TIME_URI

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Session:
    """Where to listen and how to read what comes; the defaults are what gamesr-stream sends.

    `parameter_sets` are SPS and PPS as Annex B, for a stream that has none in itself; `send_time_id` is the number of the
    header extension abs-send-time, None where there is none.
    """

    address: tuple[str, int]
    payload_type: int = PAYLOAD_TYPE
    send_time_id: int | None = SEND_TIME_ID
    parameter_sets: bytes = b""


def write_sdp(host: str, port: int, parameter_sets: list[bytes], fps: int) -> str:
    """The description of a stream of gamesr-stream to `host` (an IP address); SPS first, NAL units without start codes."""
    version = ipaddress.ip_address(host).version
    sets = ",".join(base64.b64encode(unit).decode() for unit in parameter_sets)
    lines = [
        "v=0",
        f"o=- 0 0 IN IP{version} {host}",
        "s=gamesr-stream",
        f"c=IN IP{version} {host}",
        "t=0 0",
        f"m=video {port} RTP/AVPF {PAYLOAD_TYPE}",
        "a=rtcp-mux",
        f"a=rtpmap:{PAYLOAD_TYPE} H264/{CLOCK_HZ}",
        f"a=fmtp:{PAYLOAD_TYPE} packetization-mode=1;profile-level-id={parameter_sets[0][1:4].hex()};sprop-parameter-sets={sets}",
        f"a=rtcp-fb:{PAYLOAD_TYPE} nack pli",
        f"a=extmap:{SEND_TIME_ID} {SEND_TIME_URI}",
        f"a=framerate:{fps}",
    ]
    return "\r\n".join([*lines, ""])


def read_sdp(text: str) -> Session:
    """The first H.264 video of a description. Raises InputError where there is none that can be received."""
    try:
        description = SessionDescription.parse(text.replace("; ", ";"))
        for media in description.media:
            for codec in media.rtp.codecs:
                if codec.mimeType.lower() == "video/h264" and codec.clockRate == CLOCK_HZ and codec.payloadType is not None:
                    extensions = [extension.id for extension in media.rtp.headerExtensions if extension.uri == SEND_TIME_URI]
                    return Session(
                        (media.host or description.host or LOOPBACK, media.port),
                        codec.payloadType,
                        extensions[0] if extensions else None,
                        _parameter_sets(codec.parameters.get("sprop-parameter-sets")),
                    )
    except (AssertionError, AttributeError, IndexError, KeyError, StopIteration, TypeError, ValueError) as error:
        raise InputError("the session description (SDP) cannot be read: it is cut short or of another kind") from error
    raise InputError("the session description (SDP) has no H.264 video at 90 kHz")


def _parameter_sets(value: object) -> bytes:
    if not isinstance(value, str):
        return b""
    try:
        return b"".join(b"\0\0\0\1" + base64.b64decode(unit, validate=True) for unit in value.split(",") if unit)
    except binascii.Error as error:
        raise ValueError("sprop-parameter-sets is not base64") from error
