"""Over real sockets: from gamesr-stream to frames, and what a receiver does when nobody takes them or nobody sends."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from aiortc.rtp import RtpPacket

from client import stream_cli
from client.access_unit import AccessUnit
from client.cloud import NetworkSettings
from client.errors import InputError
from client.live import LiveDecoder, Received, live_frames
from client.loss import LossRule
from client.pipeline import Restart, upscale_stream
from client.receiver import UNITS_QUEUED, RtpReceiver
from client.reception import Reception
from client.sdp import LOOPBACK, Session, read_sdp
from client.sender import RtpSender, RtpStream, Sent, Unit, stream
from client.sink import NullSink
from client.stream_source import EncodedFile, EncodedLive
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from server.link import Weather
from tests.conftest import FRAMES
from tests.lossy import LossyProxy
from tests.streaming import CALM, planes
from tests.test_rtp import unit

MakeClip = Callable[..., Path]
LONG_S = 60.0  # on a machine with much else to do


@pytest.fixture
def receiver() -> Iterator[RtpReceiver]:
    with RtpReceiver(Session((LOOPBACK, 0))) as listening:
        yield listening


def frames_of(receiver: RtpReceiver, decoder: LiveDecoder | None = None) -> list[Received]:
    """Until the sender says goodbye."""
    end = time.monotonic() + LONG_S

    def idle() -> None:
        assert time.monotonic() < end

    return list(live_frames(receiver, decoder or LiveDecoder(), idle))


@pytest.mark.parametrize("options", [None, {"bf": "2", "b-adapt": "0", "g": "6"}], ids=["in-order", "b-frames"])
def test_a_file_arrives_as_it_is(make_clip: MakeClip, receiver: RtpReceiver, options: dict[str, str] | None) -> None:
    clip = make_clip(options=options)
    thread = threading.Thread(target=stream_cli.main, args=([str(clip), "--to", f"{LOOPBACK}:{receiver.address[1]}", "--copy"],))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signal, "signal", lambda *_: None)  # of the main thread alone
        thread.start()
        got = frames_of(receiver)
        thread.join()
    want = [planes(frame) for frame in read_frames(clip)]
    assert [planes(item.frame) for item in got] == want and len(got) == FRAMES  # also those that wait to be reordered at the goodbye
    assert not any(item.frame.damaged for item in got) and receiver.counts.lost == 0
    pts = [item.frame.pts for item in got]
    assert [b - a for a, b in itertools.pairwise(pts)] == [3000] * (len(got) - 1)
    for item in got:
        assert item.unit.sent_ns is not None and item.unit.sent_ns - 20_000 <= item.unit.first_ns <= item.unit.last_ns <= item.packet_ns


def test_packets_of_another_payload_type_in_the_stream_are_not_missed() -> None:
    """Such as error correction: of the same SSRC, numbered along. They bring nothing, and none is lost; those of others are ignored."""
    ours, reception, units = RtpStream(), Reception(wall_offset_ns=0), []
    for number in range(30):
        datagrams = list(ours.datagrams(Unit(unit(number, 5 if number == 0 else 1), number * 1500), lambda: 0))
        repair = RtpPacket.parse(datagrams[-1])
        repair.payload_type, repair.sequence_number = 127, ours._sequence
        ours._sequence = (ours._sequence + 1) & 0xFFFF
        foreign = RtpPacket(127, 1, number, 0, ours.ssrc ^ 1, b"sound")
        for datagram in (*datagrams, repair.serialize(), foreign.serialize()):
            units += reception.take(datagram, ("127.0.0.1", 5000), number * 16_000_000)
    units += reception.release(10**10)
    assert [whole.data for whole in units] == [unit(number, 5 if number == 0 else 1) for number in range(30)]
    assert not any(whole.damaged for whole in units) and reception.feedback(10**10) is None
    counts = reception.counts
    assert (counts.lost, counts.ignored, counts.senders, counts.malformed) == (0, 30, 1, 0)


def test_a_request_over_sockets_brings_an_idr(make_clip: MakeClip, receiver: RtpReceiver, model_file: Callable[..., Path]) -> None:
    """The whole way: encoder, proxy that loses, receiver, decoder, network; the state starts again where damage begins and ends."""
    clip = make_clip(frames=90, options={"crf": "10", "g": "1"})
    source = EncodedLive(clip, 48, NetworkSettings(1000, 60, idr_interval_s=60))
    with LossyProxy(receiver.address, Weather(loss=0.05, duplicate=0.02), CALM, seed=4) as proxy:

        def run() -> None:
            with RtpSender(*proxy.address) as sender:
                for _ in stream(source, sender):
                    pass
                time.sleep(0.05)

        thread = threading.Thread(target=run)
        thread.start()
        end = time.monotonic() + LONG_S
        decoder, upscaler = LiveDecoder(), OnnxUpscaler(model_file())

        def idle() -> None:
            if not thread.is_alive() or time.monotonic() > end:
                receiver.close()  # the goodbye may have been lost too

        done = list(upscale_stream(live_frames(receiver, decoder, idle), upscaler, NullSink()))
        thread.join()
    counts = receiver.counts
    assert counts.lost > 0 and counts.keyframe_requests > 0 and counts.damaged_units > 0
    damaged = [item.decoded.damaged for item in done]
    assert any(damaged) and not all(damaged)
    assert [item.restart is Restart.DAMAGE for item in done[1:]] == [a and not b for a, b in itertools.pairwise(damaged)]


def test_who_takes_nothing_loses_everything_but_no_memory(receiver: RtpReceiver) -> None:
    with RtpSender(*receiver.address) as sender:
        for number in range(3 * UNITS_QUEUED):
            sender.send(Unit(unit(number, 5 if number == 0 else 1, slices=1), number * 1500))
            time.sleep(0.0005)
        end = time.monotonic() + LONG_S
        while receiver.counts.units < 3 * UNITS_QUEUED - receiver.counts.lost and time.monotonic() < end:
            time.sleep(0.01)
        counts = receiver.counts
        assert len(receiver._units) <= UNITS_QUEUED and counts.overflowed_units >= UNITS_QUEUED + 1
        while receiver.next_unit(0.05):
            pass
        sender.send(Unit(unit(999, 5, slices=1), 999 * 1500))
        last = receiver.next_unit(LONG_S)
        assert last is not None and not last.damaged  # an IDR ends this damage as any other


def test_a_queue_that_overflows_damages_what_follows(receiver: RtpReceiver) -> None:
    """Even where several units are completed by one packet, which closed a gap."""
    outgoing = RtpStream()
    sent = [
        d for n in range(UNITS_QUEUED + 8) for d in outgoing.datagrams(Unit(unit(n, 5 if n == 0 else 1, slices=1), n * 1500), time.time_ns)
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        for datagram in [*sent[:60], *sent[61:70], sent[60], *sent[70:]]:
            wire.sendto(datagram, receiver.address)
        end = time.monotonic() + LONG_S
        while receiver.counts.packets < len(sent) and time.monotonic() < end:
            time.sleep(0.01)
    left = []
    while (got := receiver.next_unit(0.05)) is not None:
        left.append(got)
    rule = LossRule()
    assert receiver.counts.overflowed_units and left and all(got.damaged and rule.admit(got) for got in left)


def test_a_flood_of_which_nothing_is_shown_keeps_nobody_waiting() -> None:
    """Whoever waits for pictures is asked with every unit, or he could not end."""
    outgoing, reception = RtpStream(), Reception(wall_offset_ns=0)
    datagrams = [d for n in range(3) for d in outgoing.datagrams(Unit(unit(n), n * 1500), lambda: 0)]
    flood = [got for datagram in datagrams for got in reception.take(datagram, ("127.0.0.1", 1), 0)]
    asked: list[int] = []

    class Flooded:
        taken = 0

        @property
        def ended(self) -> bool:
            return len(asked) == 20

        def next_unit(self, timeout_s: float) -> AccessUnit:
            self.taken += 1
            assert self.taken <= 20
            return flood[0 if self.taken == 1 else 1]

        def request_keyframe(self) -> None:
            pass

    receiver, decoder = Flooded(), LiveDecoder()
    assert list(live_frames(receiver, decoder, lambda: asked.append(receiver.taken))) == []  # type: ignore[arg-type]
    assert asked == list(range(1, 21)) and decoder.without_start


def test_silence_is_told(receiver: RtpReceiver) -> None:
    assert receiver.sender_address is None and receiver.silent_ns is None and receiver.next_unit(0.01) is None
    with RtpSender(*receiver.address) as sender:
        sender.send(Unit(unit(0, 5), 0))
        assert receiver.next_unit(LONG_S) is not None
        time.sleep(0.02)
        silent_ns = receiver.silent_ns
        assert silent_ns is not None and silent_ns >= 20_000_000 and not receiver.ended
    end = time.monotonic() + LONG_S
    while not receiver.ended:
        assert time.monotonic() < end
    receiver.close()
    assert receiver.next_unit(0) is None


def test_addresses_that_cannot_be(receiver: RtpReceiver) -> None:
    with pytest.raises(InputError, match="cannot listen on"):
        RtpReceiver(Session((LOOPBACK, receiver.address[1])))
    with pytest.raises(InputError, match="no address"):
        RtpSender("no such host.invalid", 1)


def test_a_source_that_is_late_slows_down_instead_of_bursting(receiver: RtpReceiver) -> None:
    class Slow:
        answers_requests = True
        taken = 0

        def parameter_sets(self) -> list[bytes]:
            return []

        def due_ns(self) -> int | None:
            return self.taken * 20_000_000 if self.taken < 8 else None

        def take(self, *, idr: bool) -> Unit:
            if self.taken == 3:
                time.sleep(0.1)
            self.taken += 1
            return Unit(unit(self.taken), self.taken * 1800)

    with RtpSender(*receiver.address) as sender:
        at_ns = [time.perf_counter_ns() for _ in stream(Slow(), sender)]
    assert at_ns[-1] - at_ns[3] >= 4 * 20_000_000 - 20_000_000  # what comes after the late one keeps its distances


def test_the_command(make_clip: MakeClip, receiver: RtpReceiver, tmp_path: Path) -> None:
    """Encodes, describes itself, sends over and over, and at Ctrl-C says goodbye and what it did."""
    clip, sdp = make_clip(width=128, height=96), tmp_path / "stream.sdp"
    arguments = [str(clip), "--to", f"{LOOPBACK}:{receiver.address[1]}", "--height", "48", "--bitrate", "500k", "--loop", "--sdp", str(sdp)]
    program = [sys.executable, "-c", "import sys; from client.stream_cli import main; sys.exit(main())", *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(Path.cwd())}) as process:
        try:
            units = [receiver.next_unit(LONG_S) for _ in range(2 * FRAMES + 3)]
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=LONG_S)[0]
        finally:
            process.kill()
    assert process.returncode == 130 and " pictures in " in said and "kbit/s" in said
    assert all(got is not None and not got.damaged for got in units)
    assert [got.timestamp for got in units if got] == [3000 * n for n in range(2 * FRAMES + 3)]
    session = read_sdp(sdp.read_text())
    assert session.address == receiver.address and session.parameter_sets and units[0] and session.parameter_sets[5:] in units[0].data
    assert stream_cli.main([*arguments]) == 1  # the description is there already


def test_the_command_keeps_nothing_of_what_it_sent(make_clip: MakeClip, capsys: pytest.CaptureFixture[str]) -> None:
    """With --loop it goes on for days."""

    class Watched(Sent):
        pass

    def sent(source: object, sender: object) -> Iterator[Sent]:
        seen = []
        for number in range(8):
            done = Watched(1000, 2, 0 if number else 1_000_000_000)
            seen.append(weakref.ref(done))
            yield done
        assert sum(ref() is not None for ref in seen) <= 2  # this one, and the caller's

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("client.sender.stream", sent)
        assert stream_cli.main([str(make_clip()), "--to", f"{LOOPBACK}:9", "--copy"]) == 0
    assert (
        capsys.readouterr().out == "8 pictures in 16 packets, 240 kbit/s on the wire; 1 late by more than 33.3 ms; 0 key frame requests\n"
    )


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--height", "20"], "cannot be reduced to a height of 20 evenly"),
        (["--height", "96"], "cannot be reduced to a height of 96 evenly"),
    ],
)
def test_refusals(make_clip: MakeClip, capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str) -> None:
    assert stream_cli.main([str(make_clip()), "--to", "127.0.0.1:9", *arguments]) == 1
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--copy", "--height", "24"], ["--bitrate", "8"], ["--to", "nowhere"], ["--fps", "0"]])
def test_wrong_usage(make_clip: MakeClip, arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        stream_cli.main([str(make_clip()), "--to", "127.0.0.1:9", *arguments])


def test_another_codec_is_not_copied(make_clip: MakeClip) -> None:
    with pytest.raises(InputError, match="leave out --copy"):
        EncodedFile(make_clip("clip.mkv", codec="mpeg4", options={}))


def test_the_lines_of_the_docs_are_ours() -> None:
    lines = [
        line.split() for line in (Path(__file__).parent.parent / "docs/play.md").read_text().splitlines() if "    gamesr-stream " in line
    ]
    assert len(lines) >= 3
    for _, *arguments in lines:
        stream_cli.parser().parse_args(arguments)
