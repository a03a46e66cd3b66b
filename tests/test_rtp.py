"""What stands on aiortc's packets: numbers, order, access units, session descriptions."""

from __future__ import annotations

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client.access_unit import AccessUnit, inspect, nal_units, parameter_sets, recovery_point
from client.errors import InputError
from client.reception import KEYFRAME_INTERVAL_NS, SILENCE_NS, Reception
from client.reorder import PACKETS_HELD, ReorderBuffer
from client.rtp import CLOCK_HZ, asks_for_keyframe, extensions_map, keyframe_request, parse_rtp, send_time, transit_ns, unwrap
from client.sdp import LOOPBACK, Session, read_sdp, write_sdp
from client.sender import RtpStream, Unit, packetise

MS = 1_000_000
HERE, THERE = ("127.0.0.1", 5000), ("127.0.0.1", 6000)
SPS, PPS = bytes.fromhex("6742c01fda014016e840000003004000000c03c60ca8"), bytes.fromhex("68ce3c80")


def unit(number: int, kind: int = 1, slices: int = 3, size: int = 900) -> bytes:
    """An access unit in form: slices of noise, in front of an IDR its parameter sets."""
    noise = random.Random(number)
    head = [SPS, PPS] if kind == 5 else []
    bodies = [bytes([0x60 | kind, 0x80 if n == 0 else 0x40]) + bytes(noise.randrange(1, 256) for _ in range(size)) for n in range(slices)]
    return b"".join(b"\0\0\0\1" + nal for nal in head + bodies)


def packets(stream: RtpStream, number: int, kind: int = 1, size: int = 900, now_ns: int = 0) -> list[bytes]:
    return list(stream.datagrams(Unit(unit(number, kind, size=size), number * CLOCK_HZ // 60), lambda: now_ns))


def heard(reception: Reception, sent: list[bytes], step_ns: int = 10 * MS) -> list[AccessUnit]:
    """What a receiver makes of datagrams that come `step_ns` apart."""
    return [u for n, d in enumerate(sent) for u in reception.take(d, HERE, n * step_ns) + reception.release(n * step_ns)]


@given(st.integers(-(2**40), 2**40), st.integers(-(2**31) + 1, 2**31 - 1))
def test_unwrapping_finds_the_number_again(near: int, apart: int) -> None:
    assert unwrap((near + apart) % 2**32, near, 32) == near + apart
    assert unwrap((near + (apart >> 16)) % 2**16, near, 16) == near + (apart >> 16)


@given(st.integers(0, 2**62), st.integers(0, 31_000 * MS))
def test_send_time_tells_the_transit_within_its_resolution(sent_ns: int, transit: int) -> None:
    assert abs(transit_ns(send_time(sent_ns), sent_ns + transit) - transit) <= 2 * 3815


@given(st.lists(st.binary(min_size=2, max_size=4000).map(lambda b: bytes([0x61]) + bytes(x or 1 for x in b)), min_size=1, max_size=12))
def test_payloads_are_below_the_mtu_and_give_the_unit_back(nals: list[bytes]) -> None:
    data = b"".join(b"\0\0\0\1" + nal for nal in nals)
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    sent = [*packets(stream, 0, 5), *stream.datagrams(Unit(data, 3000), lambda: 0)]
    assert all(len(payload) <= 1300 for payload in packetise(data)) and all(len(datagram) <= 1320 for datagram in sent)
    units = [whole for datagram in sent for whole in reception.take(datagram, HERE, 0)]
    assert [list(nal_units(whole.data)) for whole in units] == [list(nal_units(unit(0, 5))), nals]
    marks = [parse_rtp(datagram, extensions_map(None)).marker for datagram in sent]  # type: ignore[union-attr]
    assert marks[-1] == 1 and sum(marks) == 2


def test_a_unit_is_there_with_its_marker_and_knows_its_times(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, reception = RtpStream(), Reception(wall_offset_ns=500 * MS)
    monkeypatch.setattr(stream, "_sequence", 65_000)  # it wraps
    for number in range(400):
        kind = 5 if number == 0 else 1
        sent = packets(stream, number, kind, now_ns=(500 + 16 * number) * MS)
        done = [reception.take(datagram, HERE, (16 * number + 1 + n) * MS) for n, datagram in enumerate(sent)]
        assert [len(units) for units in done] == [0, 0, 1]
        (whole,) = done[-1]
        assert whole.data == unit(number, kind)
        assert (whole.timestamp, whole.packets, whole.lost_packets, whole.damaged) == (number * 1500, 3, 0, False)
        assert (whole.first_ns, whole.last_ns) == ((16 * number + 1) * MS, (16 * number + 3) * MS)
        assert whole.sent_ns is not None and abs(whole.sent_ns - 16 * number * MS) < 10_000


def test_timestamps_rise_over_their_wrap(monkeypatch: pytest.MonkeyPatch) -> None:
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    monkeypatch.setattr(stream, "_first_timestamp", 2**32 - 4000)
    monkeypatch.setattr(stream, "_sequence", 65_533)
    stamps = [whole.timestamp for n in range(6) for d in packets(stream, n, 5) for whole in reception.take(d, HERE, n * MS)]
    assert stamps == [n * 1500 for n in range(6)] and reception.counts.lost == 0


@given(st.permutations(range(12)), st.sets(st.integers(1, 10)))
def test_any_order_within_the_wait_comes_out_in_order(order: list[int], missing: set[int]) -> None:
    buffer: ReorderBuffer[int] = ReorderBuffer(0, PACKETS_HELD, 8 * MS)
    passed = []
    for number in [n for n in order if n not in missing] * 2:
        passed += buffer.push(number, number, 1 * MS)
    assert buffer.duplicates == 12 - len(missing)
    passed += buffer.release(8 * MS)
    assert buffer.due_ns() is None or buffer.due_ns() == 9 * MS
    passed += buffer.release(9 * MS)
    assert [number for _, number in passed] == [n for n in range(12) if n not in missing]
    assert sum(count for count, _ in passed) == buffer.lost == len(missing) and buffer.due_ns() is None
    for number in missing:
        assert buffer.push(number, number, 9 * MS) == []
    assert buffer.late == len(missing)


def test_a_flood_of_early_packets_is_bounded() -> None:
    buffer: ReorderBuffer[int] = ReorderBuffer(0)
    for number in range(1, 100_000, 2):
        buffer.push(number, number, 0)
        assert len(buffer._held) <= PACKETS_HELD + 1 and len(buffer._given_up) <= 2048


def test_the_first_sender_is_the_only_one_until_it_is_silent() -> None:
    mine, other, reception = RtpStream(), RtpStream(), Reception(wall_offset_ns=0)
    stray = packets(other, 0, 5)[0]
    assert reception.take(stray, THERE, 0) == [] and reception.sender is None  # one packet is no sender
    for number in range(10):
        now_ns = number * 16 * MS
        assert [1 for datagram in packets(other, number, 5) if reception.take(datagram, THERE, now_ns)] == [1]
        for datagram in packets(mine, number, 5):
            assert reception.take(datagram, HERE, now_ns) == []
    assert reception.sender == THERE and reception.counts.ignored == 30
    silent_ns = 9 * 16 * MS + SILENCE_NS
    units = [whole for d in packets(mine, 10, 5) for whole in reception.take(d, HERE, silent_ns)]
    assert reception.sender == HERE and [whole.restarted for whole in units] == [True]
    assert reception.counts.senders == 2 and not units[0].damaged


@pytest.mark.parametrize("kind", ["another SSRC", "a jump"])
def test_a_sender_that_starts_again_is_recognised(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    before = [whole for n in range(3) for d in packets(stream, n, 5) for whole in reception.take(d, HERE, n * 16 * MS)]
    if kind == "a jump":
        monkeypatch.setattr(stream, "_sequence", (stream._sequence + 20_000) % 65536)
    else:
        stream = RtpStream()
    after = [whole for n in range(3) for d in packets(stream, n, 5) for whole in reception.take(d, HERE, (n + 30) * 16 * MS)]
    assert [whole.restarted for whole in after] == [True, False, False]
    assert not any(whole.damaged for whole in after) and reception.counts.lost == 0
    assert after[0].timestamp - before[-1].timestamp == 28 * 16 * CLOCK_HZ // 1000  # the clock went on meanwhile


@pytest.mark.parametrize(
    ("lost", "damaged"),
    [
        ({3}, {1, 2, 3}),
        ({5}, {1, 2, 3}),
        ({5, 6}, {1, 2, 3}),
        ({6}, {2, 3}),
        ({3, 4, 5}, {2, 3}),
        ({11}, {3}),
        ({12}, {4, 5}),
        ({14}, {4, 5}),
    ],
)
def test_what_a_lost_packet_damages(lost: set[int], damaged: set[int]) -> None:
    """Pictures of three packets each, of which 0 and 4 are IDRs with their parameter sets in the first packet."""
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    sent = [datagram for n in range(6) for datagram in packets(stream, n, 5 if n in (0, 4) else 1)]
    units = heard(reception, [datagram for n, datagram in enumerate(sent) if n not in lost])
    assert sum(whole.lost_packets for whole in units) == reception.counts.lost == len(lost)
    assert {whole.timestamp // 1500 for whole in units if whole.damaged} == damaged
    assert len(units) == (5 if len(lost) == 3 else 6)


def test_an_idr_behind_a_gap_counts_only_where_nothing_can_be_missing_in_front_of_it() -> None:
    for first, clean in ((0, True), (1, False)):  # with its parameter sets, and without
        stream, reception = RtpStream(), Reception(wall_offset_ns=0)
        sent = packets(stream, 0, 5) + packets(stream, 1)[:2] + packets(stream, 2, 5)[first:]
        units = heard(reception, sent)
        assert [whole.damaged for whole in units] == [False, True, not clean]


def test_padding_does_not_hide_the_gap_in_front_of_it() -> None:
    """Of an IDR's three packets the first is lost and the second, in this case, only pads."""
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    sent = packets(stream, 0, 5) + packets(stream, 1) + packets(stream, 2, 5)
    padding = parse_rtp(sent[7], extensions_map(None))
    assert padding is not None
    padding.payload, padding.padding_size = b"", 4
    assert [whole.damaged for whole in heard(reception, [*sent[:6], padding.serialize(), sent[8]])] == [False, False, True]


def test_requests_are_few_and_go_to_the_stream() -> None:
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    requests = []
    for number in range(60):
        for datagram in packets(stream, number):
            reception.take(datagram, HERE, number * 16 * MS)
            requests += [(number, feedback) for feedback in [reception.feedback(number * 16 * MS)] if feedback]
    assert len(requests) == 60 * 16 * MS // KEYFRAME_INTERVAL_NS or len(requests) == 60 // 7 + 1
    assert all(asks_for_keyframe(feedback, stream.ssrc) and not asks_for_keyframe(feedback, stream.ssrc ^ 1) for _, feedback in requests)


def test_the_bitrate_is_that_of_the_time_in_which_packets_came() -> None:
    """However long nobody sent before, and nothing comes after."""
    stream, reception, size = RtpStream(), Reception(wall_offset_ns=0), 0
    for number in range(101):
        for datagram in packets(stream, number, 5):
            reception.take(datagram, HERE, 60_000 * MS + number * 16 * MS)
            size += len(datagram)
    reception.release(90_000 * MS)
    assert reception.counts.span_ns == 1600 * MS and reception.counts.kbps == pytest.approx(size * 8 / 1.6 / 1000)


def test_goodbye_is_believed_of_the_sender_alone() -> None:
    mine, other, reception = RtpStream(), RtpStream(), Reception(wall_offset_ns=0)
    for datagram in packets(mine, 0, 5):
        reception.take(datagram, HERE, 0)
    for goodbye, address in ((mine.goodbye(), THERE), (other.goodbye(), HERE), (mine.report(), HERE)):
        reception.take(goodbye, address, 0)
        assert not reception.ended
    reception.take(mine.goodbye(), HERE, 0)
    assert reception.ended


def test_a_stream_that_goes_on_behind_its_goodbye_is_taken_up_again_but_stragglers_are_not() -> None:
    """Whoever can write a sender's address can say goodbye in its name."""
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    heard(reception, packets(stream, 0, 5), MS)
    stragglers = packets(stream, 1)
    reception.take(stream.goodbye(), HERE, 100 * MS)
    for datagram in stragglers:
        reception.take(datagram, HERE, 101 * MS)
    assert reception.ended and reception.counts.senders == 1 and reception.feedback(101 * MS) is None
    units = [whole for datagram in packets(stream, 2) for whole in reception.take(datagram, HERE, 133 * MS)]
    assert not reception.ended and reception.counts.senders == 2
    assert [(whole.restarted, whole.damaged) for whole in units] == [(True, True)]
    assert reception.feedback(134 * MS) is not None  # it asks for a key frame
    assert reception.take(stream.goodbye(), HERE, 140 * MS) == [] and reception.ended


@pytest.mark.parametrize("gone", [1, 2], ids=["in-the-middle", "with-the-marker"])
def test_what_waits_at_the_goodbye_is_not_lost(gone: int) -> None:
    """Nothing can fill a gap any more, and a picture whose last packet is missing is damaged."""
    stream, reception = RtpStream(), Reception(wall_offset_ns=0)
    sent = [packets(stream, number, 5 if number == 0 else 1) for number in range(3)]
    del sent[2][gone]
    units = [whole for datagrams in sent for datagram in datagrams for whole in reception.take(datagram, HERE, 0)]
    assert len(units) == 2 and not reception.ended
    last = reception.take(stream.goodbye(), HERE, 0)
    assert [(whole.timestamp, whole.packets, whole.whole, whole.damaged) for whole in last] == [(3000, 2, False, True)]
    assert reception.ended and not any(whole.damaged for whole in units) and reception.counts.units == 3
    assert reception.take(stream.goodbye(), HERE, 0) == []


@given(st.integers(0, 65_535), st.booleans(), st.booleans(), st.binary(max_size=300).filter(lambda b: b[:1] != b"\6"))
def test_recovery_points_are_read_behind_any_other_message(count: int, exact: bool, broken: bool, other: bytes) -> None:
    code = f"{count + 1:b}"
    bits = "0" * (len(code) - 1) + code + f"{exact:b}{broken:b}00" + "1"
    body = int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")
    size = len(other)
    message = bytes([5] + [255] * (size // 255) + [size % 255]) + other + bytes([6, len(body)]) + body + b"\x80"
    escaped = bytearray()
    for octet in message:  # 7.4.1
        if octet <= 3 and escaped[-2:] == b"\0\0":
            escaped.append(3)
        escaped.append(octet)
    expected = count if exact and not broken else None
    assert recovery_point(bytes(escaped)) == expected
    assert inspect(b"\0\0\1\6" + bytes(escaped) + b"\0\0\1\x41\x9a").recovery_frames == expected


def test_of_many_messages_only_the_first_are_looked_into() -> None:
    """Megabytes of them, octet by octet, would keep the receiver from its packets for seconds."""
    other, point, start = b"\5\1\x11", b"\6\1\xc4", b"\0\0\1\6"
    assert [recovery_point(other * count + point + b"\x80") for count in (0, 160, 180, 1_000_000)] == [0, 0, None, None]
    units = [(start + other + b"\x80") * count + start + point + b"\x80" for count in (15, 16)]
    assert [inspect(unit).recovery_frames for unit in units] == [0, None]


@given(st.binary(max_size=64))
def test_any_sei_is_read(sei: bytes) -> None:
    assert (recovery_point(sei) or 0) >= 0
    inspect(b"\0\0\1\6" + sei)


def test_a_description_says_what_is_sent() -> None:
    text = write_sdp("127.0.0.1", 5004, parameter_sets(unit(0, 5)), 60)
    assert "profile-level-id=42c01f;" in text and text.endswith("\r\n")
    assert read_sdp(text) == Session(("127.0.0.1", 5004), parameter_sets=b"\0\0\0\1" + SPS + b"\0\0\0\1" + PPS)


def test_descriptions_of_others() -> None:
    text = "SDP:\nv=0\no=- 0 0 IN IP4 127.0.0.1\ns=No Name\nc=IN IP4 192.0.2.1\nt=0 0\nm=audio 7 RTP/AVP 0\nm=video 5006 RTP/AVP 102\n"
    assert read_sdp(text + "a=rtpmap:102 H264/90000\na=fmtp:102 packetization-mode=1; sprop-parameter-sets=Z0I=,aM4=") == Session(
        ("192.0.2.1", 5006), 102, None, b"\0\0\0\1gB\0\0\0\1h\xce"
    )
    for broken in (
        "",
        text,
        text.replace("IN IP4 192", "192"),
        text + "a=rtpmap:102 H264/90000\na=fmtp:102 sprop-parameter-sets=Z0I",
        "m=\n",
    ):
        with pytest.raises(InputError):
            read_sdp(broken)
    assert read_sdp(text.replace("c=IN IP4 192.0.2.1\n", "") + "a=rtpmap:102 H264/90000\n").address == (LOOPBACK, 5006)


def test_a_request_is_a_compound_that_begins_with_a_report() -> None:
    datagram = keyframe_request(1, 2)
    kinds, position = [], 0
    while position < len(datagram):
        _, kind, words = struct.unpack_from("!BBH", datagram, position)
        kinds.append(kind)
        position += 4 * words + 4
    assert kinds == [201, 202, 206]  # RR, SDES, PSFB
