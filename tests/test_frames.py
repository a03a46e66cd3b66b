"""What a frame is, and that nothing else passes for one: not into a model, not into a figure."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client.compare import ComparisonWriter
from client.errors import OutputError
from client.frames import Frame, plane_shapes
from client.quality import squared_error, ssim
from client.upscaler import OnnxUpscaler
from client.video import VideoSource, read_frames
from tests.moving import picture

ModelFile = Callable[..., Path]
MakeClip = Callable[..., Path]


def planes(*shapes: tuple[int, ...], dtype: type = np.uint8) -> list[np.ndarray]:
    return [np.zeros(shape, dtype) for shape in shapes]


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (planes(*plane_shapes(6, 8), dtype=np.float32), "uint8 code values, not float32"),
        ([planes((6, 8), dtype=np.uint16)[0], *planes((3, 4), (3, 4))], "not uint16, uint8, uint8"),
        ([np.zeros((6, 8), bool), *planes((3, 4), (3, 4))], "not bool"),
        (planes((6, 8), (6, 8), (6, 8)), r"\(6, 8\), \(6, 8\), \(6, 8\) are not a picture in 4:2:0"),
        (planes((6, 8), (3, 8), (3, 8)), "4:2:0"),
        (planes((6, 8), (1, 1), (3, 4)), "4:2:0"),
        (planes((6, 8), (0, 4), (0, 4)), "4:2:0"),
        (planes((0, 0), (0, 0), (0, 0)), "4:2:0"),
        (planes((6, 8, 1), (3, 4), (3, 4)), "4:2:0"),
        (planes((48,), (12,), (12,)), "4:2:0"),
    ],
)
def test_planes_that_are_no_420_picture_are_refused(given: list[np.ndarray], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Frame(*given)


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (6, 8)])
def test_any_size_and_any_stride_is_a_picture(size: tuple[int, int]) -> None:
    wide = planes(*((rows, 3 * columns) for rows, columns in plane_shapes(*size)))
    frame = Frame(*(plane[::-1, ::3] for plane in wide))
    assert (frame.height, frame.width) == size


def test_figures_are_of_planes_that_are_alike() -> None:
    plane = np.zeros((12, 12), np.uint8)
    for other in (plane[:1], plane[:, :1], np.zeros((13, 12), np.uint8), plane / 255, plane.astype(np.uint16)):
        for figure in (squared_error, ssim):
            with pytest.raises(ValueError, match="only uint8 planes of one shape"):
                figure(plane, other)


def test_a_state_is_of_the_upscaler_that_made_it(model_file: ModelFile) -> None:
    """Its buffers are bound to that model: another would go on with the first one's pictures."""
    one, other = OnnxUpscaler(model_file()), OnnxUpscaler(model_file(gain=0.25))
    frame = picture(0, 16, 24)
    _, state = one.step(frame, one.initial_state(16, 24))
    for misused in (lambda: other.step(frame, state), lambda: other.begin_again(state)):
        with pytest.raises(ValueError, match="made by another upscaler"):
            misused()
    one.step(frame, state)  # and is not consumed by that


def test_tensors_are_taken_over_as_values_whatever_their_type(model_file: ModelFile) -> None:
    upscaler = OnnxUpscaler(model_file())
    values = np.arange(8 * 12, dtype=np.float64).reshape(1, 1, 8, 12)
    for given in (values, values.astype(np.float16), values.astype(np.int32), np.asfortranarray(values)):
        np.testing.assert_array_equal(upscaler.state_of(16, 24, [given]).tensors()[0], values.astype(np.float32))
    for refused in ([values[..., :6]], [values.swapaxes(2, 3)], [values, values], [], [values[:, :1, :1]]):
        with pytest.raises(ValueError, match="are no state of tiny, which has"):
            upscaler.state_of(16, 24, refused)


def test_what_no_model_can_run_on_is_refused(model_file: ModelFile) -> None:
    for threads in (0, -1, 2.5, 5000):
        with pytest.raises(ValueError, match="not a whole number from 1 to 1024"):
            OnnxUpscaler(model_file(), threads=threads)
    with pytest.raises(ValueError, match="no pixels"):
        OnnxUpscaler(model_file()).initial_state(0, 8)


def test_a_closed_video_says_so(make_clip: MakeClip) -> None:
    """FFmpeg would read what was freed, which ended the process."""
    with VideoSource(make_clip()) as source:
        begun = iter(source)
        first = next(begun).frame
        kept = first.y.copy()
    for stream in (begun, iter(source)):
        with pytest.raises(ValueError, match="was closed"):
            next(stream)
    np.testing.assert_array_equal(first.y, kept)


def test_decoded_planes_are_the_decoders_to_write(make_clip: MakeClip) -> None:
    frame = next(read_frames(make_clip()))
    for plane in (frame.y, frame.u, frame.v):
        with pytest.raises(ValueError, match="read-only"):
            plane[0, 0] = 0


def test_a_picture_that_could_not_be_written_at_the_end_is_refused_at_the_beginning(
    make_clip: MakeClip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with VideoSource(make_clip()) as source, pytest.raises(OutputError, match="may not be written to"):
        ComparisonWriter(tmp_path / "c.png", source)


@pytest.mark.parametrize(("ending", "status"), [(">/dev/full", 1), (">&-", 0), ("2>&-", 0), ("<&-", 0)])
def test_a_command_outlives_its_streams(ending: str, status: int, tmp_path: Path) -> None:
    """A full disk is one sentence, and what nobody wants to hear goes nowhere."""
    script = "import sys; from client.profile import main; sys.exit(main())"
    command = f"{sys.executable} -c '{script}' --model bicubic --frames 1 --json {ending} 2>{tmp_path / 'said'}"
    if ending == "2>&-":
        command = command.replace(f"2>{tmp_path / 'said'}", "")
    result = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120, check=False)
    said = (tmp_path / "said").read_text() if (tmp_path / "said").exists() else ""
    assert result.returncode == status, said
    assert "Traceback" not in said and "Exception ignored" not in said
    assert said.count("\n") == status


def test_a_player_whose_stderr_is_closed_says_nothing_on_stdout(tmp_path: Path) -> None:
    script = "import sys; from client.play_cli import main; sys.exit(main())"
    command = f"{sys.executable} -c '{script}' {tmp_path / 'missing.mp4'} --sink null 2>&-"
    result = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120, check=False)
    assert (result.returncode, result.stdout) == (1, "")
