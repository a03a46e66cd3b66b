"""gamesr-skipping: its scenes, what it says of them, and what it refuses."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client.models import find_model
from client.upscaler import OnnxUpscaler
from server.skipping import ROWS, RateControl, main, measure, menu, panel, pause, repeated
from tests.moving import picture

FRAMES = [picture(t) for t in range(12)]


def test_scenes_are_still_where_they_say() -> None:
    assert [frame is FRAMES[index // 2] for index, frame in enumerate(repeated(FRAMES))] == [True] * 12
    panels, menus = list(panel(FRAMES)), list(menu(FRAMES))
    for still in ([f.y[:, :42] for f in panels], [f.y[:36] for f in menus], [f.u[:, :18] for f in menus]):
        assert all(np.array_equal(area, still[0]) for area in still)
    assert not np.array_equal(panels[0].y, panels[1].y) and not np.array_equal(menus[0].y, menus[1].y)
    paused = list(pause(FRAMES))
    assert len(paused) == 18 and all(frame is FRAMES[3] for frame in paused[3:15]) and paused[15] is FRAMES[3]


def test_rate_controls_override_the_clouds() -> None:
    params = RateControl(4000, 60, over=":crf=23").x264_params()
    assert params.startswith("bitrate=4000:") and params.endswith(":crf=23") and "ref=1" in params


def test_a_row_counts_what_was_skipped_and_bicubic_loses_nothing() -> None:
    upscaler = OnnxUpscaler(find_model("bicubic", 2), threads=1)
    row = measure("clip", FRAMES, repeated, "lossless", 1000, upscaler)
    assert (row.frames, row.tiles_skipped, row.differing_pixels, row.max_difference, row.psnr_y_lost_db) == (12, 0.5, 0, 0, 0)
    row = measure("clip", FRAMES, pause, "lossless", 1000, upscaler)
    assert row.frames == 18 and row.tiles_skipped == pytest.approx(12 / 18) and row.max_difference == 0
    assert row.whole_psnr_y_db > 20 and row.whole_ms > 0 and row.skipping_ms > 0


def test_the_command_prints_a_row_a_scene(make_clip: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip(pictures=FRAMES, width=144, height=96)
    arguments = [str(clip), "--model", "bicubic", "--frames", "8", "--kbps", "500"]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + len(ROWS) and len({line.count("|") for line in lines}) == 1
    assert main([*arguments, "--json"]) == 0
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(record["scene"], record["rate_control"]) for record in records] == [(scene.__name__, rate) for scene, rate in ROWS]
    sha256 = hashlib.sha256(find_model("bicubic", 2).read_bytes()).hexdigest()
    assert {(record["model"], record["sha256"], record["provider"]) for record in records} == {("bicubic", sha256, "cpu")}


@pytest.mark.parametrize(("size", "frames"), [((64, 50), 8), ((64, 48), 5)])
def test_a_clip_that_does_not_fit_is_refused(
    make_clip: Callable[..., Path], capsys: pytest.CaptureFixture[str], size: tuple[int, int], frames: int
) -> None:
    clip = make_clip(width=size[0], height=size[1], frames=frames)
    assert main([str(clip), "--model", "bicubic"]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""  # no head of a table that will not come
    assert captured.err == (
        f"gamesr-skipping: {clip} has {frames} frames of {size[0]}x{size[1]}: this needs 8, with sides that are multiples of 4\n"
    )


def test_a_bitrate_that_is_none_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["clip.mp4", "--kbps", "-1"])
    assert ended.value.code == 2
    assert "-1 is not a whole number from 1 to 1000000" in capsys.readouterr().err
