"""gamesr-play over real sockets: restarts, silence, a late start, loss; the player goes on by itself and says what happened."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from client.cloud import NetworkSettings
from client.play_rtp import RtpSource
from client.play_source import FileSource, open_source
from client.player import Player
from client.reception import ReceptionCounts
from client.sdp import LOOPBACK, Session, write_sdp
from client.sender import RtpSender, Unit, stream
from client.stream_source import EncodedFile, EncodedLive
from client.tiers import TieredUpscaler
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from tests.conftest import FRAMES, HEIGHT, WIDTH
from tests.lossy import LossyProxy, Weather
from tests.playing import LONG_NS, Kept, Told
from tests.streaming import CALM, planes
from tests.test_rtp import unit

MakeClip = Callable[..., Path]
LONG_S = 30.0


class Playing:
    """A player of RTP in this thread, and senders in others."""

    def __init__(self, source: RtpSource, tiers: TieredUpscaler, told: Told) -> None:
        self.source, self.tiers, self.told, self.sink = source, tiers, told, Kept()
        self.address = source._receiver.address
        self._end = time.monotonic() + LONG_S

    def play(self, *, until: Callable[[], bool] = lambda: False) -> Player:
        """Until it ends by itself, or that."""

        def over() -> str | None:
            return "enough" if until() or time.monotonic() > self._end else None

        player = Player(self.source, self.tiers, self.sink, tell=self.told, over=over, deadline_ns=LONG_NS)
        player.play()
        assert time.monotonic() < self._end
        return player


@pytest.fixture
def listening(model_file: Callable[..., Path]) -> Callable[..., object]:
    @contextmanager
    def listen(*, until_bye: bool = False, session: Session | None = None, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Iterator[Playing]:
        tiers, told = TieredUpscaler([str(model_file())], display_height=None, provider="cpu", threads=1), Told()
        tiers.prepare(*size)
        with RtpSource(session or Session((LOOPBACK, 0)), until_bye=until_bye, tell=told) as source:
            yield Playing(source, tiers, told)

    return listen


def send(address: tuple[str, int], *clips: Path, skip: int = 0) -> threading.Thread:
    """Clips one after the other, each from a sender of its own."""

    def run() -> None:
        for clip in clips:
            with RtpSender(*address) as sender:
                source = EncodedFile(clip)
                for _ in range(skip):
                    source.take(idr=False)
                for _ in stream(source, sender):
                    pass

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_a_stream_is_shown_as_the_upscaler_makes_it(
    make_clip: MakeClip, model_file: Callable[..., Path], listening: Callable[..., Playing]
) -> None:
    clip = make_clip()
    with listening(until_bye=True) as playing:
        thread = send(playing.address, clip)
        player = playing.play()
        thread.join()
    upscaler = OnnxUpscaler(model_file())
    state = upscaler.initial_state(HEIGHT, WIDTH)
    for frame, shown in zip(read_frames(clip), playing.sink.pictures, strict=True):
        want, state = upscaler.step(frame, state)
        assert planes(shown) == planes(want)
    summary = player.summary("done", {})
    record = summary.record()
    assert record["frames"] == {"shown": FRAMES, "late": 0, "left_out": 0, "unready": 0, "damaged": 0, "repeated": 0}
    latencies = player.tally.latencies(network=True)
    assert set(latencies) == {"receive", "assemble", "queue", "decode", "upscale", "present", "total", "sent"}
    stages = player.tally.durations_ns(network=True)
    assert (stages["assemble"] >= 0).all() and (stages["queue"] >= 0).all()
    parts = sum(stages[stage] for stage in ("assemble", "queue", "decode", "upscale", "present"))
    assert (parts == stages["total"]).all()  # no time is in no stage
    assert "sent" in summary.text() and str(FRAMES) in summary.text()
    longer = ReceptionCounts(packets=900, bytes=1_000_000, span_ns=2_000_000_000)  # than pictures were shown
    assert " 4000 kbit/s, 900 packets" in replace(summary, reception=longer).text()


def test_it_goes_on_after_a_goodbye_and_a_restart(make_clip: MakeClip, listening: Callable[..., Playing]) -> None:
    """Also where the next stream has another size; --until-bye would have ended with the first."""
    clips = [make_clip("a.mp4"), make_clip("b.mp4", width=96, height=64), make_clip("c.mp4")]
    with listening() as playing:
        thread = send(playing.address, *clips)
        player = playing.play(until=lambda: not thread.is_alive() and playing.source._receiver.ended)
        thread.join()
    tally = player.tally
    assert playing.told.kinds().count("sender") == 3
    assert sum("started again" in sentence for _, sentence in playing.told.said) == 2
    assert tally.shown + tally.unready == 3 * FRAMES
    assert playing.source.reception.senders == 3 and tally.damaged == 0


def test_silence_is_said_and_survived(make_clip: MakeClip, listening: Callable[..., Playing]) -> None:
    clip = make_clip()
    first = EncodedFile(clip)
    with listening() as playing:

        def run() -> None:
            with RtpSender(*playing.address) as sender:
                for number in range(FRAMES):
                    sender.send(first.take(idr=False))
                    time.sleep(0.02)
                    if number == 5:
                        end = time.monotonic() + LONG_S
                        while "silence" not in playing.told.kinds() and time.monotonic() < end:
                            time.sleep(0.02)

        thread = threading.Thread(target=run)
        thread.start()
        player = playing.play(until=lambda: "goodbye" in playing.told.kinds())
        thread.join()
    assert playing.told.kinds().count("silence") == 2 and player.tally.shown == FRAMES and player.tally.freezes >= 1


def test_a_start_without_an_idr_waits_for_one_and_says_so(make_clip: MakeClip, listening: Callable[..., Playing]) -> None:
    """The clip has an IDR every six pictures; the player joins at the third."""
    clip = make_clip(frames=14)
    with listening(until_bye=True) as playing:
        thread = send(playing.address, clip, skip=2)
        player = playing.play()
        thread.join()
    assert "no_key_frame" in playing.told.kinds() and player.tally.shown == 8
    want = [planes(frame) for frame in read_frames(clip)][6:]
    assert len(want) == 8 and player.tally.damaged == 0


def test_a_key_frame_that_nobody_has_looked_at_is_not_missed() -> None:
    told = Told()
    with RtpSource(Session((LOOPBACK, 0)), until_bye=True, tell=told) as source, RtpSender(*source._receiver.address) as sender:
        sender.send(Unit(unit(0, 5), 0))
        end = time.monotonic() + LONG_S
        while not source.waiting() and time.monotonic() < end:
            time.sleep(0.005)
        source._watch()  # as while nothing comes, which may end just then
    assert source.waiting() == 1 and told.kinds() == ["sender"]


def test_bursts_of_loss_end_by_themselves(make_clip: MakeClip, listening: Callable[..., Playing]) -> None:
    """Encoder, network that loses in bursts, player: damaged frames are shown and counted, key frames asked for, and it ends clean."""
    clip = make_clip(frames=60, options={"crf": "10", "g": "1"})
    source = EncodedLive(clip, HEIGHT, NetworkSettings(1000, 60, idr_interval_s=60))
    with listening() as playing, LossyProxy(playing.address, Weather(loss=0.05, burst_packets=3), CALM, seed=7) as proxy:

        def run() -> None:
            with RtpSender(*proxy.address) as sender:
                for _ in stream(source, sender):
                    pass

        thread = threading.Thread(target=run)
        thread.start()
        player = playing.play(until=lambda: not thread.is_alive())
        thread.join()
    counts, tally = playing.source.reception, player.tally
    assert counts.lost > 0 and counts.keyframe_requests > 0
    assert 0 < tally.damaged < tally.shown and tally.restarts["damage"] >= 1


def test_a_session_description_is_listened_to(make_clip: MakeClip, tmp_path: Path, model_file: Callable[..., Path]) -> None:
    """The address, and the parameter sets that an .mp4's stream may have nowhere else."""
    clip, told = make_clip(), Told()
    with RtpSource(Session((LOOPBACK, 0)), until_bye=True, tell=told) as free:
        port = free._receiver.address[1]
    description = tmp_path / "stream.sdp"
    description.write_text(write_sdp(LOOPBACK, port, EncodedFile(clip).parameter_sets(), 30))
    with open_source(str(description), until_bye=True, tell=told) as source:
        assert isinstance(source, RtpSource) and source._receiver.address == (LOOPBACK, port)
        thread = send((LOOPBACK, port), clip)
        assert len(list(source.frames(lambda: None))) == FRAMES
        thread.join()


def test_a_file_arrives_in_real_time(make_clip: MakeClip) -> None:
    """Every frame, none before its time."""
    clip = make_clip(options={"bf": "2", "g": "6"})
    with FileSource(clip, tell=Told()) as source:
        items = list(source.frames(lambda: None))
    assert [planes(item.frame) for item in items] == [planes(frame) for frame in read_frames(clip)]
    assert all(item.last_ns <= item.packet_ns <= item.decoded_ns for item in items)
    arrivals = [item.last_ns for item in items]
    assert arrivals == sorted(arrivals) and arrivals[-1] - arrivals[0] >= (FRAMES - 4) * 1_000_000_000 // 30


def test_a_file_of_any_claimed_rate_is_played(tmp_path: Path) -> None:
    path = tmp_path / "fast.y4m"
    path.write_bytes(b"YUV4MPEG2 W32 H32 F2000000000:1 Ip A1:1 C420mpeg2\n" + (b"FRAME\n" + bytes(1536)) * 5)
    with FileSource(path, tell=Told()) as source:
        assert [source.waiting() >= 0 for _ in source.frames(lambda: None)] == [True] * 5


def test_a_file_that_is_played_too_slowly_waits_and_then_slows_down(make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many wait as are due; it does not run after a lost second."""
    monkeypatch.setattr("client.play_source._BEHIND_NS", 200_000_000)
    told, waited, clip = Told(), [], make_clip()
    with FileSource(clip, tell=told) as source:
        items = []
        for item in source.frames(lambda: None):
            items.append(item)
            if len(items) == 1:
                time.sleep(0.5)
            waited.append(source.waiting())
    assert len(items) == FRAMES and waited[0] >= 14 and "slow" in told.kinds() and waited[-1] == 0
    assert [planes(item.frame) for item in items] == [planes(frame) for frame in read_frames(clip)]


def test_the_defaults_of_an_address(make_clip: MakeClip) -> None:
    with RtpSource(Session((LOOPBACK, 0)), until_bye=True, tell=Told()) as taken:
        port = taken._receiver.address[1]
    for text in (f":{port}", f"{LOOPBACK}:{port}", f"rtp://{LOOPBACK}:{port}", f"localhost:{port}"):
        with open_source(text, until_bye=True, tell=Told()) as source:
            assert isinstance(source, RtpSource) and source._receiver.address == (LOOPBACK, port)
