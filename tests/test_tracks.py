"""Sound and subtitles that cannot be copied: left out by name, and the picture is upscaled all the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import pytest

from client.sink import FileSink
from client.video import VideoSource, read_frames
from tests.conftest import FRAMES

MakeClip = Callable[..., Path]
TS_PACKET = 188


def copied(clip: Path, output: Path) -> list[str]:
    """What is said of a copy of the picture, which has to be whole and alone."""
    with VideoSource(clip) as source, FileSink(output, source) as sink:
        for decoded in source:
            sink.write(decoded.frame)
    assert len(list(read_frames(output))) == FRAMES
    with av.open(str(output)) as container:
        assert [stream.type for stream in container.streams] == ["video"]
    return sink.notes


def with_subtitles(clip: Path) -> Path:
    path, text = clip.with_name("subtitled.mkv"), clip.with_name("words.srt")
    text.write_text("1\n00:00:00,100 --> 00:00:00,300\nHello\n")
    with av.open(str(clip)) as film, av.open(str(text)) as words, av.open(str(path), "w") as container:
        targets = {stream.type: container.add_stream_from_template(stream) for stream in (*film.streams, *words.streams)}
        for packet in (*film.demux(), *words.demux()):
            if packet.size:
                packet.stream = targets[packet.stream.type]
                container.mux(packet)
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize(("codec", "kind"), [(b"A_AAC", "audio"), (b"S_TEXT/UTF8", "subtitle")])
def test_a_track_of_an_unknown_codec_is_left_out(make_clip: MakeClip, tmp_path: Path, codec: bytes, kind: str, suffix: str) -> None:
    clip = make_clip("clip.mkv", audio="aac" if kind == "audio" else None)
    clip = clip if kind == "audio" else with_subtitles(clip)
    content = clip.read_bytes()
    assert content.count(codec) == 1
    clip.write_bytes(content.replace(codec, codec[:2] + b"X" * (len(codec) - 2)))
    assert copied(clip, tmp_path / f"out.{suffix}") == [f"{kind} track 1 is left out: its codec is not known here"]


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_sound_that_is_announced_and_does_not_come_is_left_out(make_clip: MakeClip, tmp_path: Path, suffix: str) -> None:
    clip = make_clip("clip.ts", audio="aac")
    with av.open(str(clip)) as container:
        pid = container.streams.audio[0].id
    content = clip.read_bytes()
    packets = [content[begin : begin + TS_PACKET] for begin in range(0, len(content), TS_PACKET)]
    clip.write_bytes(b"".join(packet for packet in packets if int.from_bytes(packet[1:3], "big") & 0x1FFF != pid))
    (note,) = copied(clip, tmp_path / f"out.{suffix}")
    assert note.startswith("audio track 1 (aac) is left out: none was found")
