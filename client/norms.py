"""LayerNorms over channels as OpenVINO computes them fastest: where the channels are, instead of behind two transpositions."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

LAST, BACK = [0, 2, 3, 1], [0, 3, 1, 2]  # axes of the transpositions that bring channels to the end and back
LAST_AXIS = ([-1], [-1, 0, 1])  # of the norm: as it is, or as the ends and the step of a range
NORM = {"normalize_variance": True, "eps_mode": "INSIDE_SQRT"}


def norms_in_place(ov: ModuleType, model: Any) -> int:
    """Rewrite every LayerNorm over the channels of (N, C, H, W) in an `openvino.Model`; returns how many there were.

    An artifact has them as ONNX has them, over the last axis, between two transpositions, which ONNX Runtime computes well. For
    OpenVINO, whose convolutions leave channels last in memory already, all of that is passes over memory: a third of the time of `gamesr`.
    The weights are the same, and so is the result, but for the order of its sums. What looks otherwise is left as it is.
    """
    ops = ov.opset13
    found = 0
    for norm in [node for node in model.get_ordered_ops() if node.get_type_name() == "MVN"]:
        first, scaled = norm.input_value(0).get_node(), _only_user(norm)
        shifted = _only_user(scaled)
        last = _only_user(shifted)
        chain = [node.get_type_name() if node else "" for node in (first, scaled, shifted, last)]
        if chain != ["Transpose", "Multiply", "Add", "Transpose"] or not norm.get_attributes().items() >= NORM.items():
            continue
        axes = _numbers(norm.input_value(1))
        if (_numbers(first.input_value(1)), _numbers(last.input_value(1))) != (LAST, BACK) or axes not in LAST_AXIS:
            continue
        count = norm.get_output_partial_shape(0)[-1]
        if any(
            len(_numbers(node.input_value(1))) != count or node.get_element_type().get_type_name() != "f32" for node in (scaled, shifted)
        ):
            continue
        scale, shift = (ops.reshape(node.input_value(1), [-1, 1, 1], False) for node in (scaled, shifted))
        channels = ops.constant([1])
        x = first.input_value(0)
        x = ops.subtract(x, ops.reduce_mean(x, channels, True))
        variance = ops.reduce_mean(ops.multiply(x, x), channels, True)
        deviation = ops.sqrt(ops.add(variance, ops.constant(np.float32(norm.get_attributes()["eps"]))))
        x = ops.multiply(x, ops.divide(ops.constant(np.float32(1)), deviation))
        last.output(0).replace(ops.add(ops.multiply(x, scale), shift).output(0))
        found += 1
    return found


def _only_user(node: Any) -> Any:
    """The node that alone takes what this one gives, or None."""
    users = node.output(0).get_target_inputs() if node else ()
    return next(iter(users)).get_node() if len(users) == 1 else None


def _numbers(value: Any) -> list[float]:
    """What a constant holds, or each of the three constants of a range; nothing for any other value."""
    node = value.get_node()
    if node.get_type_name() == "Range":
        return [number for part in node.input_values() if part.get_node().get_type_name() == "Constant" for number in _numbers(part)]
    return list(node.get_data().flat) if node.get_type_name() == "Constant" else []
