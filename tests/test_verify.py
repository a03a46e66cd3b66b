"""Holding an artifact against its reference: no error is lost on the way to its bound, and what is no artifact of ours is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from client.errors import InputError, ModelError
from client.frames import Frame
from client.models import find_model
from model.artifact_weights import network_of_artifact
from model.cli import verify_main
from model.hard_cases import noise, there_and_back
from model.trial import BOUNDS, broken_by
from model.verify import StepError, crop, parity_row, parse_size, step_error

SOUND = StepError("cpu", 1, 0, 0, 0.0, None, 1e-7, 1e-8, 1.0, 1000)
BOUND = BOUNDS["float32"]


@pytest.mark.parametrize("place", [0, 100, 199])
@pytest.mark.parametrize("figure", ["max_state_error", "largest_state"])
def test_an_error_that_is_no_number_breaks_a_bound_in_any_frame(figure: str, place: int) -> None:
    errors = [SOUND] * 200
    assert not broken_by(errors, BOUND)
    errors[place] = replace(SOUND, **{figure: np.nan})
    assert broken_by(errors, BOUND) == ["nan of state error, at most 3e-05 allowed"]


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("figure", ["max_state_error", "rms_state_error"])
def test_an_error_that_is_no_number_is_shown_in_whatever_frame(figure: str, place: int) -> None:
    errors = [SOUND] * 3
    assert "nan" not in parity_row("any", errors)
    errors[place] = replace(SOUND, **{figure: np.nan})
    assert parity_row("any", errors).count("| nan |") == 1


@pytest.mark.parametrize("place", [0, 1])
def test_a_state_that_is_no_number_is_one_in_its_figures(place: int) -> None:
    planes = [np.zeros(shape, np.uint8) for shape in ((4, 6), (2, 3), (2, 3))]
    state = [np.ones((1, 2, 2, 3)), np.ones((1, 2, 2, 3))]
    error = step_error("cpu", 1, Frame(*planes), [part.copy() for part in state], planes, state)
    assert (error.samples, error.largest_state, error.max_state_error) == (36, 1, 0)
    poisoned = [part.copy() for part in state]
    poisoned[place][0, 0, 0, 0] = np.nan
    error = step_error("cpu", 1, Frame(*planes), poisoned, planes, state)
    assert np.isnan([error.largest_state, error.max_state_error, error.rms_state_error]).all()


def test_the_share_that_differs_is_one_of_samples_and_not_of_frames() -> None:
    small, large = (replace(SOUND, differing_pixels=share, samples=count) for share, count in ((0.5, 6), (0.0, 10_000)))
    assert not broken_by([small, large], BOUND)
    (broken,) = broken_by([replace(small, samples=10_000), replace(large, samples=6)], BOUND)
    assert broken == "0.5 of the samples differ, at most 0.001 allowed"


NO_SIZES = ["", "x", "64", "64x", "x48", "0x48", "63x48", "64x47", "-64x48", "64 x48", "²x2", "64x48x2", "9" * 5000 + "0x2"]


@pytest.mark.parametrize("text", NO_SIZES, ids=lambda text: text[:8])
def test_what_is_no_size_is_refused(text: str) -> None:
    assert parse_size("64x48") == (64, 48)
    with pytest.raises(InputError, match="is not a size: write 320x180, both even"):
        parse_size(text)


def test_a_crop_keeps_nothing_else_in_memory() -> None:
    (frame,) = noise(101, 75, 1)
    for size in ((64, 48), (200, 200)):
        cut = crop(frame, *size)
        assert all(plane.base is None for plane in (cut.y, cut.u, cut.v))


@pytest.mark.parametrize("length", [1, 2, 5, 6, 7, 30])
def test_a_clip_is_read_no_further_than_it_is_played(length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """There are six frames; those that are played are the same as if all had been read."""
    frames = list(noise(8, 6, 6))
    read: list[Frame] = []

    def read_frames(_: Path) -> Iterator[Frame]:
        for frame in frames:
            read.append(frame)
            yield frame

    def parity(_: Path, cut: list[Frame], steps: int, **__: object) -> Iterator[StepError]:
        for step, (frame, expected) in enumerate(zip(there_and_back(cut, steps), there_and_back(frames, steps), strict=True), 1):
            assert np.array_equal(frame.y, expected.y)
            yield replace(SOUND, step=step)

    monkeypatch.setattr("model.cli.read_frames", read_frames)
    monkeypatch.setattr("model.cli.parity", parity)
    assert verify_main([str(find_model("gamesr", 2)), "clip.mkv", "--steps", str(length)]) == 0
    assert len(read) == min(length, 6)


@pytest.mark.parametrize("steps", ["0", "-1"])
def test_there_is_a_step_at_least(steps: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        verify_main(["model.onnx", "clip.mkv", "--steps", steps])
    assert f"--steps: {steps} is not a whole number from 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("gamesr", "x"),
        ("gamesr", 7),
        ("gamesr", None),
        ("gamesr", ["ab"]),
        ("gamesr", {"architecture": ["lean"]}),
        ("gamesr", {"scale": 3}),
        ("gamesr", {"scale": "2"}),
        ("gamesr", {"colour": "grey"}),
        ("gamesr", {"channels": 16}),
        ("gamesr", {"channels": -1}),
        ("gamesr", {"blocks": 9}),
        ("gamesr", {"recurrent": False}),
        ("live", {"architecture": "fsrcnn"}),
        ("live", {"scale": 3}),
        ("live", {"channels": 16}),
        ("live", {"blocks": -1}),
    ],
    ids=str,
)
def test_an_artifact_that_is_not_the_network_that_it_says_is_refused_in_a_sentence(
    name: str, said: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    proto = onnx.load(find_model(name, 2))
    entry = next(p for p in proto.metadata_props if p.key == "card")
    card = json.loads(entry.value)
    card["network"] = {**card["network"], **said} if isinstance(said, dict) else said
    entry.value = json.dumps(card)
    onnx.save(proto, tmp_path / "foreign.onnx")
    with pytest.raises(ModelError):
        network_of_artifact(tmp_path / "foreign.onnx")
    assert verify_main([str(tmp_path / "foreign.onnx"), "--hard", "short", "--cases", "black"]) == 1
    (sentence,) = capsys.readouterr().err.splitlines()
    assert sentence.startswith("gamesr-verify: ")


@pytest.mark.parametrize("dtype", [np.float32, object])
def test_weights_that_are_none_are_refused(dtype: type, tmp_path: Path) -> None:
    """The graph keeps its own; beside them lies what has the name of one, of another shape or of text."""
    proto = onnx.load(find_model("gamesr", 2))
    name = "network.lstm.gates.weight"
    for node in proto.graph.node:
        node.input[:] = ["moved" if wanted == name else wanted for wanted in node.input]
    next(tensor for tensor in proto.graph.initializer if tensor.name == name).name = "moved"
    shape = (128, 64, 3, 3) if dtype is object else (7,)
    proto.graph.initializer.append(onnx.numpy_helper.from_array(np.full(shape, "1", dtype), name))
    onnx.save(proto, tmp_path / "foreign.onnx")
    with pytest.raises(ModelError, match="has other weights than the network that it says it is"):
        network_of_artifact(tmp_path / "foreign.onnx")
