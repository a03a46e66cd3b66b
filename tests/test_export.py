"""Artifacts: what they say of themselves, torch against ONNX Runtime over many steps, baselines against torch's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from client.errors import ModelError
from client.frames import Frame
from client.upscaler import OnnxUpscaler
from model.artifact_weights import network_of_artifact
from model.export import export_baseline, export_network
from model.verify import parity
from tests.networks import random_clip, random_network


def frames(height: int, width: int, count: int = 8) -> list[Frame]:
    clip = random_clip(1, count, height, width)
    return [Frame(*(plane[0, t, 0].to(torch.uint8).numpy() for plane in clip)) for t in range(count)]


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("artifacts")
    paths = {}
    for preset, scale in (("paper", 2), ("planes", 2), ("planes", 3), ("planes-no-lstm", 2), ("balanced", 2), ("live", 3)):
        paths[f"{preset}_x{scale}"] = folder / f"{preset}_x{scale}.onnx"
        export_network(random_network(preset, scale), paths[f"{preset}_x{scale}"], name=preset, card={"steps": 0})
    return paths


@pytest.mark.parametrize("name", ["paper_x2", "planes_x2", "planes_x3", "planes-no-lstm_x2", "balanced_x2", "live_x3"])
def test_artifact_equals_float64_over_recurrent_steps(artifacts: dict[str, Path], name: str) -> None:
    errors = list(parity(artifacts[name], frames(24, 40), 40))
    assert len(errors) == 40
    assert max(e.max_code_error for e in errors) <= 1
    assert max(e.differing_pixels for e in errors) < 1e-3
    assert max(e.max_state_error for e in errors[20:]) < 1e-4


def test_parity_notices_a_wrong_weight(artifacts: dict[str, Path], tmp_path: Path) -> None:
    model = onnx.load(artifacts["planes_x2"])
    tensor = next(t for t in model.graph.initializer if t.name == "network.lstm.gates.bias")
    values = onnx.numpy_helper.to_array(tensor).copy()
    reference = network_of_artifact(artifacts["planes_x2"])
    values += 0.5
    tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))
    onnx.save(model, tmp_path / "changed.onnx")
    changed = network_of_artifact(tmp_path / "changed.onnx")
    clip = random_clip(1, 2, 24, 40)
    assert not torch.allclose(reference(clip)[0].y, changed(clip)[0].y)


def test_a_bias_that_is_zero_stays_in_the_artifact(tmp_path: Path) -> None:
    """The exporter leaves it out, and then nothing could be held against the artifact or go on from it."""
    network = random_network("fast", 2)
    torch.nn.init.zeros_(network.stem.bias)
    torch.nn.init.zeros_(network.stem.weight)
    export_network(network, tmp_path / "fast_x2.onnx", name="fast", card={})
    assert not network_of_artifact(tmp_path / "fast_x2.onnx").stem.bias.any()
    assert max(error.max_code_error for error in parity(tmp_path / "fast_x2.onnx", frames(24, 40), 4)) <= 1


def test_the_artifact_says_what_it_is(artifacts: dict[str, Path]) -> None:
    spec = OnnxUpscaler(artifacts["planes_x3"], threads=1).spec
    assert (spec.name, spec.scale, spec.size_multiple, spec.precision) == ("planes", 3, 2, "float32")
    assert [(s.input, s.output, s.channels, s.divisor) for s in spec.state] == [("h_in", "h_out", 32, 2), ("c_in", "c_out", 32, 2)]
    assert spec.card["parameters"] == 141_607
    assert OnnxUpscaler(artifacts["planes-no-lstm_x2"], threads=1).spec.state == ()


@pytest.mark.parametrize("name", ["paper_x2", "planes_x2"])
def test_the_check_of_a_state_is_no_larger_than_the_state(artifacts: dict[str, Path], name: str) -> None:
    """A sum over a frame's cells would leave float16 at 960x540; and one NaN or Inf anywhere must show."""
    session = ort.InferenceSession(artifacts[name])
    y, u, v = (np.zeros((1, 1, side, side), np.uint8) for side in (64, 32, 32))
    divisor = OnnxUpscaler(artifacts[name], threads=1).spec.state[0].divisor
    state = np.full((1, 32, 64 // divisor, 64 // divisor), 30, np.float32)

    def check(cell: np.ndarray) -> float:
        return float(session.run(["state_sum"], {"y": y, "u": u, "v": v, "h_in": state, "c_in": cell})[0])

    assert 0 < abs(check(state)) <= 1 + 31  # the mean of a hidden state, a tanh's, and of a cell, which grows by 1
    for wrong in (np.nan, np.inf):
        cell = state.copy()
        cell[0, 7, 3, 2] = wrong
        assert not np.isfinite(check(cell))


@pytest.mark.parametrize("name", ["planes_x2", "balanced_x2"])
@pytest.mark.parametrize("size", [(2, 2), (4, 2), (34, 46), (90, 160)])
def test_any_size_goes_through_one_artifact(artifacts: dict[str, Path], size: tuple[int, int], name: str) -> None:
    upscaler = OnnxUpscaler(artifacts[name], threads=1)
    picture, _ = upscaler.step(frames(*size, count=1)[0], upscaler.initial_state(*size))
    assert (picture.height, picture.width) == (2 * size[0], 2 * size[1])


@pytest.mark.parametrize("scale", [2, 3])
def test_bicubic_is_torchs_bicubic_and_chroma_stays_where_it_is(tmp_path: Path, scale: int) -> None:
    export_baseline("bicubic", scale, tmp_path / "bicubic.onnx", name="bicubic")
    upscaler = OnnxUpscaler(tmp_path / "bicubic.onnx", threads=1)
    frame = frames(20, 28, 1)[0]
    picture, _ = upscaler.step(frame, upscaler.initial_state(20, 28))
    expected = torch.nn.functional.interpolate(
        torch.from_numpy(frame.y)[None, None].double(), scale_factor=scale, mode="bicubic", align_corners=False
    )
    assert np.abs(expected.round().clamp(0, 255)[0, 0].numpy() - picture.y).max() <= 1
    # A ramp: chroma column k of the output lies over luma column 2k, whose place in the input is (2k + 0.5) / scale - 0.5,
    # and input chroma column j over luma column 2j. U and V must also not be mistaken for each other.
    ramp = np.tile(np.arange(0, 112, 8, dtype=np.uint8), (10, 1))
    picture, _ = upscaler.step(Frame(frame.y, ramp, 200 - ramp), upscaler.initial_state(20, 28))
    columns = np.arange(3 * scale, 10 * scale)
    place = ((2 * columns + 0.5) / scale - 0.5) / 2
    assert np.abs(picture.u[:, columns] - 8 * place).max() <= 0.8  # bicubic with a = -0.75 bends a ramp a little
    assert np.abs(200 - picture.v[:, columns] - 8 * place).max() <= 0.8  # bicubic with a = -0.75 bends a ramp a little


def test_a_baseline_has_nothing_to_verify(tmp_path: Path) -> None:
    export_baseline("lanczos", 2, tmp_path / "lanczos.onnx", name="lanczos")
    with pytest.raises(ModelError, match="is no network"):
        network_of_artifact(tmp_path / "lanczos.onnx")
