"""Streams whose pictures come in another order than their packets: every codec's in the order of presentation, damage to the right ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import pytest

from client.frames import Frame
from client.video import VideoSource, from_av_frame, read_frames
from tests.conftest import FRAMES
from tests.streaming import planes

MakeClip = Callable[..., Path]


@pytest.mark.parametrize("name", ["clip.mkv", "clip.avi"])
@pytest.mark.parametrize("codec", ["mpeg1video", "mpeg2video", "mpeg4"])
def test_b_frames_of_older_codecs_come_in_order(make_clip: MakeClip, name: str, codec: str) -> None:
    path = make_clip(name, codec=codec, options={"bf": "2", "b": "4000000"})
    with av.open(str(path)) as container:
        packets = [packet.pts or packet.dts for packet in container.demux(video=0) if packet.size]
        container.seek(0)
        want = [planes(from_av_frame(picture)) for picture in container.decode(video=0)]
    assert name == "clip.avi" or packets != sorted(packets)  # there are B-frames; an .avi does not say when they are shown
    assert [planes(frame) for frame in read_frames(path)] == want and len(want) == FRAMES


def decoded(path: Path, lost: int | None = None) -> list[Frame]:
    """The frames of a clip of which one packet is rubbish, or gets lost on the way here."""
    frames = []
    with VideoSource(path) as source:
        for number, packet in enumerate(source.packets()):
            if number == lost:
                source.distrust()
            else:
                frames += [done.frame for done in source.decode(packet)]
    return frames


@pytest.mark.parametrize("refused", [True, False])
def test_a_key_frame_that_waited_ends_no_damage_that_came_after_it(make_clip: MakeClip, refused: bool) -> None:
    """The packet behind it is lost, while it is still waiting to be reordered."""
    path = make_clip("clip.mkv", frames=24, options={"g": "8", "bf": "2", "b-adapt": "0", "preset": "ultrafast", "sc_threshold": "0"})
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    keys = [number for number, packet in enumerate(packets) if packet.is_keyframe]
    assert len(keys) == 3
    whole = {frame.pts: planes(frame) for frame in decoded(path)}
    if refused:
        content, packet = path.read_bytes(), bytes(packets[keys[1] + 1])
        assert content.count(packet) == 1
        path.write_bytes(content.replace(packet, bytes(len(packet))))
    frames = decoded(path, None if refused else keys[1] + 1)
    wrong = [frame for frame in frames if planes(frame) != whole[frame.pts]]
    assert len(wrong) > 2 and all(frame.damaged for frame in wrong)
    assert [frame.damaged for frame in frames if frame.pts >= packets[keys[2]].pts] == [False] * 8
