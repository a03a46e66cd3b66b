"""gamesr-stream --copy of files that are cut short or damaged: what is there is sent, and the goodbye."""

from __future__ import annotations

import socket
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import av
import pytest

from client import stream_cli
from client.errors import InputError
from client.rtp import CLOCK_HZ
from client.sdp import LOOPBACK
from client.stream_source import EncodedFile
from tests.conftest import FRAMES

MakeClip = Callable[..., Path]
BYE = bytes([0x81, 203, 0, 1])  # RTCP, of one source


def packets_of(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def sent(source: EncodedFile) -> list[bytes]:
    units = []
    while source.due_ns() is not None:
        units.append(source.take(idr=False).data)
    return units


def test_a_packet_that_is_no_h264_is_left_out(make_clip: MakeClip) -> None:
    clip = make_clip()
    whole, content, broken = sent(EncodedFile(clip)), clip.read_bytes(), packets_of(clip)[7]
    assert content.count(broken) == 1
    clip.write_bytes(content.replace(broken, b"\xff" * len(broken)))
    assert sent(EncodedFile(clip)) == whole[:7] + whole[8:]


def test_a_file_that_cannot_be_read_further_is_sent_up_to_there(make_clip: MakeClip, capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip()
    sizes = [len(packet).to_bytes(4, "big") for packet in packets_of(clip)]
    content, table = clip.read_bytes(), b"".join(sizes)
    assert content.count(table) == 1
    clip.write_bytes(content.replace(table, b"".join([*sizes[:7], b"\x3f\0\0\0", *sizes[8:]])))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((LOOPBACK, 0))
        receiver.settimeout(60)
        assert stream_cli.main([str(clip), "--to", f"{LOOPBACK}:{receiver.getsockname()[1]}", "--copy"]) == 0
        said = b""
        while said[-8:-4] != BYE:
            said = receiver.recv(2048)
    assert capsys.readouterr().out.startswith("7 pictures ")


@pytest.mark.parametrize("options", [None, {"bf": "2", "b-adapt": "0", "g": "6"}], ids=["in-order", "b-frames"])
def test_where_timestamps_go_back_the_stream_goes_on(make_clip: MakeClip, options: dict[str, str] | None) -> None:
    """As between two recordings in one file. Each picture is shown as long after its decoding as the file says."""
    clip = make_clip("clip.ts", options=options)
    once = times(EncodedFile(clip))
    clip.write_bytes(2 * clip.read_bytes())
    twice = times(EncodedFile(clip))
    assert len(twice) == 2 * FRAMES and [delay for _, delay in twice] == 2 * [delay for _, delay in once]
    assert all(0.033 <= after - before <= 0.034 for (before, _), (after, _) in pairwise(twice))


def test_where_timestamps_leap_the_stream_does_not_wait(make_clip: MakeClip) -> None:
    """More than a second is a leap; less is as it is."""
    clip = make_clip("clip.ts", pts=[0, 1, 2, 20, 21, 22, 90_000, 90_001, 90_002, 90_003, 90_032, 90_070])
    due = [at for at, _ in times(EncodedFile(clip))]
    assert [round(30 * (after - before)) for before, after in pairwise(due)] == [1, 1, 18, 1, 1, 1, 1, 1, 1, 29, 1]


def times(source: EncodedFile) -> list[tuple[float, int]]:
    """When each unit is due, in seconds, and how many ticks later its picture is shown."""
    found = []
    while (due_ns := source.due_ns()) is not None:
        found.append((due_ns / 1e9, round(source.take(idr=False).timestamp - due_ns * CLOCK_HZ / 1e9)))
    return found


def test_parameter_sets_that_are_none_are_one_sentence(make_clip: MakeClip) -> None:
    clip = make_clip("clip.mkv")
    sps, content = EncodedFile(clip).parameter_sets()[0], clip.read_bytes()
    sized = len(sps).to_bytes(2, "big") + sps
    assert content.count(sized) == 1
    clip.write_bytes(content.replace(sized, b"\xff\xff" + sps))
    with pytest.raises(InputError, match="damaged parameter sets"):
        EncodedFile(clip)
