"""Whatever comes in a datagram: never an exception, never more memory.

`GAMESR_FUZZ_DATAGRAMS=1000000 python -m pytest tests/test_rtp_fuzz.py` makes it a long run.
"""

from __future__ import annotations

import os
import random

import psutil
import pytest

from client.live import LiveDecoder
from client.reception import Reception
from client.reorder import PACKETS_HELD
from client.rtp import keyframe_request
from client.sender import RtpStream
from server.simulation import SENDER
from tests.streaming import INTRA, Cloud

COUNT = int(os.environ.get("GAMESR_FUZZ_DATAGRAMS", "20000"))
GROWTH_BYTES = 64 << 20
RTP_HEADER = 20  # with the header extension


def mutate(datagram: bytes, other: bytes, draw: random.Random) -> bytes:
    """One datagram in a hundred as it is; of the rest half keep their header, so that they come as far as the decoder."""
    octets = bytearray(datagram)
    begin = RTP_HEADER if draw.random() < 0.5 and len(octets) > RTP_HEADER else 0
    for _ in range(draw.choice((0, 1, 1, 2, 8)) if draw.random() < 0.99 else 0):
        match draw.randrange(7):
            case 0 if len(octets) > begin:
                octets[draw.randrange(begin, len(octets))] ^= 1 << draw.randrange(8)
            case 1 if len(octets) > begin:
                octets[draw.randrange(begin, min(len(octets), begin + 8))] = draw.choice((0, 1, 24, 28, 127, 128, 255))
            case 2:
                del octets[draw.randrange(begin, len(octets) + 1) :]
            case 3:
                octets += draw.randbytes(draw.randrange(40))
            case 4:
                octets[begin:] = other[begin:]
            case 5 if len(octets) > 4:
                octets[2:4] = draw.randbytes(2)  # the sequence number
            case 6 if len(octets) > 8:
                octets[4:8] = draw.randbytes(4)  # the timestamp
    return bytes(octets)


@pytest.mark.parametrize("seed", [1])
def test_mutated_datagrams(seed: int) -> None:
    draw = random.Random(seed)
    cloud, stream = Cloud(INTRA), RtpStream()
    pool = [datagram for n in range(90) for datagram in stream.datagrams(cloud.take(idr=n == 45), lambda: 0)]
    pool += [stream.report(), keyframe_request(1, stream.ssrc)]
    reception, decoder = Reception(wall_offset_ns=0), LiveDecoder()
    process = psutil.Process()
    now_ns = position = frames = at_first = 0
    for count in range(COUNT):
        now_ns += draw.choice((1_000, 100_000, 2_000_000, 20_000_000))
        position = draw.randrange(len(pool)) if draw.random() < 0.02 else (position + 1) % len(pool)
        datagram = mutate(pool[position], draw.choice(pool), draw)
        if count % 50 == 0:
            datagram = draw.randbytes(draw.randrange(1500))
        address = SENDER if draw.random() < 0.98 else ("192.0.2.1", 9)
        for unit in reception.take(datagram, address, now_ns) + reception.release(now_ns):
            frames += len(decoder.decode(unit))
        reception.feedback(now_ns)
        assert len(reception._order._held) <= PACKETS_HELD + 1 and len(decoder._waiting) <= 32
        if count == COUNT // 4:
            at_first = process.memory_info().rss
    assert process.memory_info().rss - at_first < GROWTH_BYTES
    counts = reception.counts
    # It went deep: units were made, pictures came out of some of them, and everything was met on the way.
    assert frames > COUNT // 1000 and counts.units > COUNT // 20 and decoder.decode_errors
    assert min(counts.lost, counts.late, counts.duplicates, counts.malformed, counts.ignored, counts.senders - 1) > 0


def test_a_unit_without_an_end_is_bounded() -> None:
    """The same timestamp for ever, never a marker: fragments that never end, and empty ones."""
    reception, stream = Reception(wall_offset_ns=0), RtpStream()
    first, second = list(stream.datagrams(Cloud(INTRA).take(), lambda: 0))[:2]
    for payload in (b"\x7c\x85", b"\x7c\x05", b"\x7c\x05" + bytes(1300), b"\x61" + bytes(1300)):
        for number in range(20_000):
            sequence = (int.from_bytes(first[2:4]) + number) % 65536
            header = bytes([first[0], first[1] & 0x7F]) + sequence.to_bytes(2) + second[4:20]
            assert not reception.take(header + payload, SENDER, 0)
        unit = reception._assembler._unit
        assert unit is not None and unit.bytes <= 8 << 20 and len(unit.parts) <= 1 << 14
