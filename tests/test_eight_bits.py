"""Products of 8 bits whose sums do not fit: on no processor do they reach the picture."""

from __future__ import annotations

import numpy as np
import pytest

from client import runtime
from client.eight_bits import FLOAT_INSTEAD, adds_up, is_in_8_bits
from client.frames import Frame
from client.models import find_model
from client.runtime import OpenVinoRuntime, _core, openvino
from client.upscaler import OnnxUpscaler

MODELS = ("fast-int8", "live-int8", "balanced-int8")


def bright() -> Frame:
    """Noise among the brightest codes, where the largest sums are."""
    rng = np.random.default_rng(0)
    return Frame(*(rng.integers(180, 256, shape, dtype=np.uint8) for shape in ((96, 160), (48, 80), (48, 80))))


@pytest.mark.parametrize("name", MODELS)
def test_openvino_computes_an_int8_model_as_onnx_runtime_does(name: str) -> None:
    """Without VNNI OpenVINO was up to 51 codes off, and 1.5 dB below in a world with a bright sky; ONNX Runtime was not."""
    pictures = []
    for provider in ("cpu", "openvino"):
        upscaler = OnnxUpscaler(find_model(name, 2), provider=provider, threads=1)
        pictures.append(upscaler.step(bright(), upscaler.initial_state(96, 160))[0])
    for plane in "yuv":
        ours, theirs = (getattr(picture, plane).astype(int) for picture in pictures)
        assert np.abs(ours - theirs).max() <= 3, plane


def test_what_is_in_8_bits_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    core = _core()
    assert [is_in_8_bits(core.read_model(find_model(name, 2))) for name in ("fast-int8", "fast")] == [True, False]
    told = []
    compile_model = core.compile_model

    class Told:
        def __getattr__(self, name: str) -> object:
            return getattr(core, name)

        def compile_model(self, model: object, device: str, options: dict[str, object]) -> object:
            told.append("LP_TRANSFORMS_MODE" in options)
            return compile_model(model, device, options)

    monkeypatch.setattr(runtime, "_core", Told)
    shapes = {"y": (1, 1, 16, 16), "u": (1, 1, 8, 8), "v": (1, 1, 8, 8)}
    for right in (True, False):
        monkeypatch.setattr(runtime, "adds_up", lambda ov, core, right=right: right)
        for name in ("fast-int8", "fast"):
            OpenVinoRuntime(find_model(name, 2).read_bytes(), threads=1, provider="openvino").request(shapes)
    assert told == [False, False, True, False]


def test_the_probe_is_right_where_the_sums_are() -> None:
    """Multiplied in float they are, on any processor; in 8 bits it says what is so, once."""
    core = _core()

    class InFloat:
        def compile_model(self, model: object, device: str, options: dict[str, object]) -> object:
            return core.compile_model(model, device, {**options, **FLOAT_INSTEAD})

    assert adds_up(openvino(), InFloat())
    assert adds_up(openvino(), core) is adds_up(openvino(), core)
