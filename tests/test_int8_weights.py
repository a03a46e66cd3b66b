"""int8 weights that are right on every processor: what fits, what is refused, and that little is lost by it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from client.errors import ModelError
from client.frames import Frame
from client.int8_weights import MOST, sums_fit
from client.models import find_model
from client.runtime import _core, openvino
from client.upscaler import OnnxUpscaler
from model.seven_bits import settled

MODELS = [(name, scale) for name in ("fast-int8", "live-int8", "balanced-int8") for scale in (2, 3)]


def bright() -> Frame:
    """Noise among the brightest codes, where the largest sums are."""
    rng = np.random.default_rng(0)
    return Frame(*(rng.integers(180, 256, shape, dtype=np.uint8) for shape in ((96, 160), (48, 80), (48, 80))))


@pytest.mark.parametrize(("name", "scale"), MODELS)
def test_openvino_computes_a_shipped_int8_model_as_onnx_runtime_does(name: str, scale: int) -> None:
    """With weights up to 127 it was up to 51 codes off without VNNI, and 1.5 dB below in a world with a bright sky."""
    assert sums_fit(_core().read_model(find_model(name, scale)))
    pictures = []
    for provider in ("cpu", "openvino"):
        upscaler = OnnxUpscaler(find_model(name, scale), provider=provider, threads=1)
        pictures.append(upscaler.step(bright(), upscaler.initial_state(96, 160))[0])
    for plane in "yuv":
        ours, theirs = (getattr(picture, plane).astype(int) for picture in pictures)
        assert np.abs(ours - theirs).max() <= 1, plane


@pytest.mark.parametrize("sign", [1, -1])
def test_the_largest_sums_that_there_can_be_are_right(sign: int) -> None:
    ov, channels, side = openvino(), 32, 16
    opset = ov.opset13
    codes = opset.parameter([1, channels, side, side], np.float32)
    rounded = opset.fake_quantize(codes, *(np.float32(limit) for limit in (0, 255, 0, 255)), 256)
    weights = opset.convert(opset.constant(np.full((channels, channels, 3, 3), sign * MOST, np.int8)), np.float32)
    scaled = opset.multiply(weights, opset.constant(np.ones((channels, 1, 1, 1), np.float32)))
    model = ov.Model([opset.convolution(rounded, scaled, [1, 1], [0, 0], [0, 0], [1, 1])], [codes])
    compiled = _core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = next(iter(compiled.create_infer_request().infer([np.full((1, channels, side, side), 255, np.float32)]).values()))
    np.testing.assert_allclose(found, sign * 255.0 * MOST * channels * 9, rtol=1e-6)


def test_weights_beyond_are_refused_where_they_could_be_wrong(tmp_path: Path) -> None:
    model = onnx.load(find_model("fast-int8", 2))
    codes = next(tensor for tensor in model.graph.initializer if tensor.name.endswith("weight_quantized"))
    beyond = numpy_helper.to_array(codes).copy()
    beyond[0, 0, 0, 0] = MOST + 1
    codes.CopyFrom(numpy_helper.from_array(beyond, codes.name))
    onnx.save(model, tmp_path / "beyond.onnx")
    for provider in ("cpu", "openvino"):
        upscaler = OnnxUpscaler(tmp_path / "beyond.onnx", provider=provider, threads=1)
        if provider == "cpu":  # where they are right
            upscaler.step(bright(), upscaler.initial_state(96, 160))
        else:
            with pytest.raises(ModelError, match="its 8-bit weights go beyond 64"):
                upscaler.initial_state(96, 160)


def test_weights_make_up_for_each_other_as_far_as_their_inputs_go_together() -> None:
    rng = np.random.default_rng(0)
    weights = rng.uniform(-MOST, MOST, (16, 36))
    mixed = rng.normal(size=(36, 12)) @ rng.normal(size=(12, 4000)) + 0.3 * rng.normal(size=(36, 4000))

    def error(rounded: np.ndarray, inputs: np.ndarray) -> float:
        return float(np.square((weights - rounded) @ inputs).mean())

    ours = settled(weights, np.cov(mixed))
    assert np.abs(ours).max() <= MOST and (ours == np.round(ours)).all()
    assert error(ours, mixed) < 0.5 * error(np.round(weights), mixed)
    np.testing.assert_array_equal(settled(weights, np.eye(36)), np.round(weights))  # nothing to make up with
    np.testing.assert_array_equal(settled(weights, np.zeros((36, 36))), np.round(weights))  # a layer that reads nothing but one colour
    assert np.abs(settled(3 * weights, np.cov(mixed))).max() == MOST
