"""A stranger at either end: ffmpeg sends to us, and receives from us by our description."""

from __future__ import annotations

import contextlib
import errno
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import imageio_ffmpeg
import pytest

from client.errors import GamesrError
from client.live import LiveDecoder
from client.receiver import RtpReceiver
from client.sdp import LOOPBACK, Session, write_sdp
from client.sender import RtpSender, stream
from client.stream_source import EncodedFile
from client.video import read_frames
from tests.streaming import planes

MakeClip = Callable[..., Path]
LONG_S = 60.0
SIZE = {"frames": 24, "width": 320, "height": 192}  # IDRs of many packets
OPTIONS = {"bf": "0", "g": "8", "crf": "12"}


@pytest.fixture
def ffmpeg() -> str:
    return str(imageio_ffmpeg.get_ffmpeg_exe())


@contextlib.contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        with process:
            yield process
    finally:
        process.kill()


@pytest.mark.parametrize("suffix", ["h264", "mp4"])
def test_ffmpeg_sends_and_we_receive(ffmpeg: str, make_clip: MakeClip, suffix: str) -> None:
    """From .h264 the parameter sets come in the stream, from .mp4 in the session description alone."""
    clip = make_clip(f"clip.{suffix}", options=OPTIONS, **SIZE)
    sets = b"".join(b"\0\0\0\1" + unit for unit in EncodedFile(clip).parameter_sets()) if suffix == "mp4" else b""
    decoder, frames = LiveDecoder(sets), []
    with RtpReceiver(Session((LOOPBACK, 0), send_time_id=None, parameter_sets=sets)) as receiver:
        target = f"rtp://{LOOPBACK}:{receiver.address[1]}"
        with running(ffmpeg, "-loglevel", "error", "-re", "-i", str(clip), "-c", "copy", "-f", "rtp", target) as process:
            end = time.monotonic() + LONG_S
            while len(frames) < SIZE["frames"] and time.monotonic() < end:
                if (unit := receiver.next_unit(0.1)) is not None:
                    frames += decoder.decode(unit)
            process.wait(LONG_S)
        time.sleep(0.1)
        assert not receiver.ended  # its goodbye goes to the port above
    assert [planes(item.frame) for item in frames] == [planes(frame) for frame in read_frames(clip)]
    assert not any(item.frame.damaged for item in frames) and all(item.unit.sent_ns is None for item in frames)
    assert receiver.counts.lost == 0


def test_we_send_and_ffmpeg_receives(ffmpeg: str, make_clip: MakeClip, tmp_path: Path) -> None:
    clip = make_clip(options=OPTIONS, **SIZE)
    source, port = EncodedFile(clip), free_port_pair()
    sdp = tmp_path / "stream.sdp"
    sdp.write_text(write_sdp(LOOPBACK, port, source.parameter_sets(), 30))
    command = [ffmpeg, "-loglevel", "error", "-protocol_whitelist", "file,udp,rtp", "-i", str(sdp)]
    with running(*command, "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "yuv420p", "pipe:1") as process:
        wait_until_taken(port)
        with RtpSender(LOOPBACK, port) as sender:
            for _ in stream(source, sender):
                pass
        try:
            raw, said = process.communicate(timeout=LONG_S)  # it ends by our goodbye
        except subprocess.TimeoutExpired as error:
            raise GamesrError("ffmpeg did not end") from error
    size = SIZE["width"] * SIZE["height"] * 3 // 2
    pictures = [raw[begin : begin + size] for begin in range(0, len(raw), size)]
    assert pictures == [planes(frame) for frame in read_frames(clip)], said.decode()


def free_port_pair() -> int:
    """An even port and the next one, which ffmpeg takes for RTCP whether it is used or not."""
    for _ in range(100):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
            first.bind((LOOPBACK, 0))
            port: int = first.getsockname()[1]
            with contextlib.suppress(OSError):
                second.bind((LOOPBACK, port + 1))
                if port % 2 == 0:
                    return port
    raise GamesrError("no two free ports")


def wait_until_taken(port: int) -> None:
    end = time.monotonic() + LONG_S
    while time.monotonic() < end:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return
                raise
        time.sleep(0.05)
    raise GamesrError("ffmpeg does not listen")
