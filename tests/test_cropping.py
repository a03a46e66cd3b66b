"""Of a coded picture just what its stream says is to be seen, from a file and live."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from av.bitstream import BitStreamFilterContext

from client.access_unit import AccessUnit, inspect
from client.live import LiveDecoder
from client.video import read_frames
from tests.conftest import HEIGHT

MakeClip = Callable[..., Path]


@pytest.mark.parametrize("left", [6, 16])
def test_a_picture_is_cropped_to_the_pixel(make_clip: MakeClip, tmp_path: Path, left: int) -> None:
    clip, cropped = make_clip("clip.h264", width=128), tmp_path / "cropped.h264"
    packets = cropped_packets(clip, left)
    cropped.write_bytes(b"".join(packets))
    live, units = LiveDecoder(), [AccessUnit(p, n, 0, 0, None, 1, 0, True, False, inspect(p)) for n, p in enumerate(packets)]
    want = [frame.y[:, left:-2] for frame in read_frames(clip)]
    for frames in (list(read_frames(cropped)), [done.frame for unit in units for done in live.decode(unit)]):
        assert all(np.array_equal(frame.y, y) for frame, y in zip(frames, want, strict=True))
        assert frames[0].u.shape == (HEIGHT // 2, (126 - left) // 2)


def cropped_packets(clip: Path, left: int) -> list[bytes]:
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        crop = BitStreamFilterContext(f"h264_metadata=crop_left={left}:crop_right=2", stream)
        return [bytes(done) for packet in container.demux(stream) if packet.size for done in crop.filter(packet)]
