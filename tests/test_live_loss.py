"""The loss rule, held against what was sent: no picture that differs is ever called clean, and clean ones come back."""

from __future__ import annotations

import av
import numpy as np
import pytest
from av.codec.context import ThreadType

import client.live
from client.cloud import CloudEncoder, NetworkSettings
from client.frames import Frame, plane_shapes
from client.live import LiveDecoder, Received
from client.quality import squared_error
from client.reception import Reception
from client.rtp import CLOCK_HZ
from client.sender import RtpStream, Unit
from client.upscaler import MAX_OUTPUT_PIXELS
from client.video import from_av_frame
from server.link import Weather
from server.simulation import SENDER
from tests.streaming import CALM, FPS, HEIGHT, IDR, INTRA, WIDTH, Played, planes, play, scene

WIDTH_IN_BLOCKS = WIDTH // 16
MODES = pytest.mark.parametrize("settings", [IDR, INTRA], ids=["idr", "intra-refresh"])


def check(played: Played) -> None:
    """What holds on any network."""
    indices = [shown.index for shown in played.shown]
    assert indices == sorted(set(indices))  # in order, each once
    assert not [shown for shown in played.shown if shown.differs and not shown.damaged]
    stamps = [item.frame.pts for item in played.received]
    assert stamps == sorted(set(stamps))


@MODES
def test_no_loss_is_bit_equal_and_nothing_waits(settings: NetworkSettings) -> None:
    played = play(settings, CALM)
    check(played)
    assert [shown.index for shown in played.shown] == list(range(played.sent))
    assert not any(shown.damaged or shown.differs for shown in played.shown)
    # Out with the marker bit: a picture needs nothing of the next one. The very first waits for a second packet to lock to.
    assert {round(shown.latency_ns / 1e6, 1) for shown in played.shown[1:]} == {5.0}
    assert played.reception.counts.keyframe_requests == 0 and played.idrs == []


@MODES
@pytest.mark.parametrize(
    "weather",
    [
        Weather(loss=0.005),
        Weather(loss=0.02),
        Weather(loss=0.05),
        Weather(loss=0.02, burst_packets=8),
        Weather(loss=0.05, burst_packets=3, reorder=0.05, duplicate=0.05, jitter_ns=2_000_000),
        Weather(loss=0.02, reorder=0.02, reorder_ns=30_000_000, delay_ns=20_000_000),  # later than anybody waits
        Weather(rate_kbps=1700),
    ],
    ids=["0.5%", "2%", "5%", "bursts", "all", "too-late", "narrow"],
)
def test_no_wrong_picture_is_called_clean(settings: NetworkSettings, weather: Weather) -> None:
    played = play(settings, weather, seed=3)
    check(played)
    damaged = [shown for shown in played.shown if shown.damaged]
    clean = [shown for shown in played.shown if not shown.damaged]
    assert played.reception.counts.lost > 0 and clean
    assert any(shown.differs for shown in damaged)  # so that the mark means something


@MODES
def test_disorder_and_doubles_that_are_waited_for_cost_nothing(settings: NetworkSettings) -> None:
    played = play(settings, Weather(reorder=0.2, duplicate=0.3, jitter_ns=3_000_000, delay_ns=5_000_000), frames=60)
    check(played)
    # Whatever came before the lock may be lost to it; nothing is from then on.
    assert played.reception.counts.duplicates > 30
    assert not any(shown.damaged for shown in played.shown[20 if settings is IDR else FPS :])
    assert len(played.shown) >= 55


def test_an_idr_that_is_asked_for_ends_the_damage() -> None:
    played = play(IDR, CALM, drop={(40, 1)})
    check(played)
    assert [shown.index for shown in played.shown if shown.damaged] == list(range(40, played.idrs[0]))
    # Found out when the picture is there, 5 ms each way: the next picture but one at the latest.
    assert played.idrs == [41] or played.idrs == [42]


def test_an_idr_that_is_lost_is_asked_for_again() -> None:
    first = play(IDR, CALM, drop={(40, 1)}).idrs[0]
    played = play(IDR, CALM, drop={(40, 1), (first, 0)})
    check(played)
    assert len(played.idrs) == 2 and played.idrs[1] - first <= FPS // 5 + 3  # asked for after 100 ms, made after 200
    assert [shown.index for shown in played.shown if shown.damaged] == list(range(40, played.idrs[1]))


@pytest.mark.parametrize("hit", [37, 59, 60, 61, 70])
def test_an_intra_refresh_heals_without_a_request(hit: int) -> None:
    played = play(INTRA, CALM, drop={(hit, 1)})
    check(played)
    assert played.idrs == [] and played.reception.counts.keyframe_requests == 0
    damaged = [shown.index for shown in played.shown if shown.damaged]
    # The refresh that begins after the loss, or with it missing nothing, must run to its end: 12 columns of blocks.
    begins = next(index for index in range(0, played.sent, FPS // 2) if index > hit)
    assert damaged == list(range(hit, begins + WIDTH_IN_BLOCKS - 2))


@pytest.mark.parametrize("lost", [{(40, n) for n in range(20)}, {(index, n) for index in range(40, 44) for n in range(20)}])
@MODES
def test_whole_pictures_lost(settings: NetworkSettings, lost: set[tuple[int, int]]) -> None:
    played = play(settings, CALM, drop=lost)
    check(played)
    last = max(index for index, _ in lost)
    assert {shown.index for shown in played.shown} >= set(range(40)) | set(range(last + 8, 150))
    assert not any(shown.damaged for shown in played.shown if shown.index < 40 or shown.index > last + FPS)
    assert next(shown for shown in played.shown if shown.index > 39).damaged


@MODES
def test_joining_late_waits_for_something_to_begin_with(settings: NetworkSettings) -> None:
    played = play(settings, CALM, join=35)
    check(played)
    if settings is IDR:  # nothing to heal by: it asks
        assert not any(shown.damaged for shown in played.shown) and played.shown[0].index == played.idrs[0] <= 38
    else:
        assert not any(shown.damaged for shown in played.shown if shown.index >= 70) and played.shown


def test_frame_num_wraps_inside_a_loss() -> None:
    """libavcodec then holds pictures back; the decoder says so and asks, instead of freezing until the counter comes round."""
    played = play(INTRA, CALM, drop={(index, n) for index in (30, 31, 32, 62, 63, 64, 65) for n in range(20)})
    check(played)
    gaps = [b.index - a.index for a, b in zip(played.shown, played.shown[1:], strict=False)]
    assert max(gaps) < 12 and played.idrs  # a refresh alone would not have brought one


@pytest.mark.parametrize("restart", [False, True], ids=["same-sender", "sender-restarts"])
def test_another_size_in_mid_stream(restart: bool) -> None:
    """As a server adapts: every picture of both sizes comes out at once and to the bit."""
    stream, reception, decoder = RtpStream(), Reception(wall_offset_ns=0), LiveDecoder()
    reference = av.CodecContext.create("h264", "r")
    reference.thread_count = 1
    got, want, now_ns, index = [], [], 0, 0
    for width, height in ((WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2), (WIDTH, HEIGHT)):
        encoder = CloudEncoder(IDR, width, height)
        stream = RtpStream() if restart else stream
        for _ in range(10):
            full = scene(index)
            crop = Frame(full.y[:height, :width], full.u[: height // 2, : width // 2], full.v[: height // 2, : width // 2])
            data = b"".join(encoder.encode(crop))
            want += [planes(from_av_frame(picture)) for picture in reference.decode(av.Packet(data))]
            for datagram in stream.datagrams(Unit(data, index * CLOCK_HZ // FPS), lambda: 0):
                now_ns += 1_000_000
                got += [item for unit in reception.take(datagram, SENDER, now_ns) for item in decoder.decode(unit)]
            index += 1
    assert [planes(item.frame) for item in got] == want and len(want) == 30
    assert not any(item.frame.damaged for item in got)
    assert reception.counts.senders == (3 if restart else 1)
    stamps = [item.frame.pts or 0 for item in got]
    assert stamps == sorted(set(stamps))


def test_a_picture_too_large_to_be_upscaled_is_refused_and_the_next_is_shown() -> None:
    """As what cannot be decoded: before there is memory for it, and without an end."""
    assert 4096 * 4112 * 4 > MAX_OUTPUT_PIXELS >= 4 * client.live.MAX_PIXELS
    stream, reception, decoder = RtpStream(), Reception(wall_offset_ns=0), LiveDecoder()
    got: list[Received] = []
    for index, (width, height) in enumerate([(WIDTH, HEIGHT), (4096, 4112), (WIDTH, HEIGHT)]):
        grey = (np.full(shape, 128, np.uint8) for shape in plane_shapes(height, width))
        data = b"".join(CloudEncoder(IDR, width, height).encode(Frame(*grey)))
        for datagram in stream.datagrams(Unit(data, index * CLOCK_HZ // FPS), lambda: 0):
            got += [item for unit in reception.take(datagram, SENDER, index) for item in decoder.decode(unit)]
    assert [(item.frame.width, item.frame.height, item.frame.damaged) for item in got] == [(WIDTH, HEIGHT, False)] * 2
    assert decoder.decode_errors == 1 and decoder.refusal == "pictures of 4096x4112 are larger than can be upscaled"


@MODES
def test_one_thread_conceals_better_than_sliced_ones(settings: NetworkSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Why the live decoder has one: should libavcodec ever conceal as well with several, it may have them."""

    def error() -> int:
        played = play(settings, CALM, drop={(index, 1) for index in range(20, 60, 10)}, frames=60)
        pairs = zip(played.shown, played.received, strict=True)
        return sum(squared_error(scene(shown.index).y, item.frame.y) for shown, item in pairs if shown.damaged)

    one = error()
    sliced = client.live._open_decoder()
    sliced.thread_type, sliced.thread_count = ThreadType.SLICE, 2
    monkeypatch.setattr(client.live, "_open_decoder", lambda: sliced)
    assert 0 < one < error()
