"""Where gamesr-play puts pictures besides a window: a file of raw pictures, and the size that is asked for."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from client.errors import OutputError
from client.frames import ColourTags, Frame
from client.play_sink import Resizer, Y4mSink
from client.video import read_frames
from tests.moving import picture


@pytest.mark.parametrize(
    "tags", [ColourTags(1, 1, 1, 1), ColourTags(2, 1, 1, 1), ColourTags(0, 2, 2, 2)], ids=["limited", "full", "unsaid"]
)
def test_resizing_changes_no_colour(tags: ColourTags) -> None:
    """A flat picture of any code value stays that, whatever its tags say; a ramp stays within a code value of itself."""
    resizer = Resizer(72, 48)
    for value in (0, 16, 100, 235, 255):
        flat = Frame(
            *(np.full(shape, value, np.uint8) for shape in ((32, 48), (16, 24), (16, 24))), colour=tags, pts=7, time_base=Fraction(1, 9)
        )
        resized = resizer.resize(flat)
        assert all((plane == value).all() for plane in (resized.y, resized.u, resized.v))
        assert (resized.width, resized.height, resized.colour, resized.pts, resized.time_base) == (72, 48, tags, 7, flat.time_base)
    ramp = np.tile((40 + 2 * np.arange(48)).astype(np.uint8), (32, 1))
    resized = resizer.resize(Frame(ramp, ramp[:16, :24].copy(), ramp[:16, :24].copy(), colour=tags))
    want = 40 + 2 * ((np.arange(72) + 0.5) / 1.5 - 0.5)
    assert np.abs(resized.y[:, 4:-4] - want[4:-4]).max() <= 1
    same = picture(0, 48, 72)
    assert resizer.resize(same) is same


def test_y4m_is_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.y4m"
    with pytest.raises(ZeroDivisionError), Y4mSink(path) as sink:
        sink.write(picture(0))
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    with Y4mSink(path):
        pass  # nothing was shown: no file
    assert list(tmp_path.iterdir()) == []
    with Y4mSink(path) as sink:
        sink.write(picture(0, 32, 48))
        sink.write(picture(1, 64, 96))  # of another size
        sink.period_ns = 1_000_000_000 * 1001 // 60000
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == Fraction(60000, 1001)
    assert [(frame.width, frame.height) for frame in read_frames(path)] == [(48, 32)] * 2
    for period_ns in (12_345, 1, 10**12):  # of times as only hostile files have them
        with Y4mSink(path, force=True) as sink:
            sink.write(picture(0))
            sink.period_ns = period_ns
        assert len(list(read_frames(path))) == 1
    for full, said in ((2, 2), (1, 1)):
        with Y4mSink(path, force=True) as sink:
            sink.write(Frame(*(np.full(s, 200, np.uint8) for s in ((4, 6), (2, 3), (2, 3))), colour=ColourTags(range=full)))
        assert next(read_frames(path)).colour.range == said
    with pytest.raises(OutputError, match="does not exist"):
        Y4mSink(tmp_path / "no" / "out.y4m")
