"""Whether OpenVINO multiplies in 8 bits on this processor without losing what does not fit.

Without VNNI (AVX2 alone, AVX512 before Cascade Lake) x86 adds two products of 8 bits up in 16 bits, and what is larger is cut off: bright
areas of the int8 models come out tens of codes wrong. No property of the runtime says so; a sum that does not fit does.
"""

from __future__ import annotations

import functools
from types import ModuleType
from typing import Any

import numpy as np

FLOAT_INSTEAD = {"LP_TRANSFORMS_MODE": "NO"}  # of `compile_model`: what is rounded to 8 bits is rounded, and multiplied as float
CHANNELS, SIDE = 32, 16  # so that it is the convolution that the models have


def is_in_8_bits(model: Any) -> bool:
    """Whether one of OpenVINO's models rounds what its layers read."""
    return any(operation.get_type_name() == "FakeQuantize" for operation in model.get_ops())


@functools.cache
def adds_up(ov: ModuleType, core: Any) -> bool:
    """A convolution of the largest values that there are, against its sum; some tens of milliseconds, once."""
    opset = ov.opset13
    codes = opset.parameter([1, CHANNELS, SIDE, SIDE], np.float32)
    rounded = opset.fake_quantize(codes, *(np.float32(limit) for limit in (0, 255, 0, 255)), 256)
    weights = opset.convert(opset.constant(np.full((CHANNELS, CHANNELS, 3, 3), 127, np.int8)), np.float32)
    scaled = opset.multiply(weights, opset.constant(np.ones((CHANNELS, 1, 1, 1), np.float32)))
    summed = opset.convolution(rounded, scaled, [1, 1], [0, 0], [0, 0], [1, 1])
    request = core.compile_model(ov.Model([summed], [codes]), "CPU", {"INFERENCE_PRECISION_HINT": "f32"}).create_infer_request()
    found = next(iter(request.infer([np.full((1, CHANNELS, SIDE, SIDE), 255, np.float32)]).values()))
    return bool(np.allclose(found, 255.0 * 127 * CHANNELS * 9, rtol=1e-3))
