"""A state's way through a graph stays float32 in OpenVINO, and nothing else does; a graph without a state is left alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import openvino
import pytest
from openvino import opset13 as ops

from client.models import shipped_models
from client.precise import states_in_float32
from tests.test_shipped import NEEDS_BFLOAT16

STATEFUL = [path for path in shipped_models() if path.stem.rpartition("_")[0] in ("gamesr", "gamesr-paper")]
STATELESS = [path for path in shipped_models() if path not in STATEFUL]


def read(core: Any, path: Path) -> Any:
    """An artifact for frames of 64x48."""
    model = core.read_model(path)
    sizes = {port: (48, 64) if port.any_name == "y" else (24, 32) for port in model.inputs}
    model.reshape({port: [1, port.partial_shape[1].get_length(), *size] for port, size in sizes.items()})
    return model


def convolutions(core: Any, model: Any) -> list[str]:
    """What a processor with bfloat16 computes each in, by the runtime's own account."""
    compiled = core.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "bf16"})
    notes = [dict(node.get_rt_info().items()) for node in compiled.get_runtime_model().get_ordered_ops()]
    return sorted(note["runtimePrecision"].astype(str) for note in notes if note["layerType"].astype(str) == "Convolution")


@NEEDS_BFLOAT16
@pytest.mark.parametrize("path", STATEFUL, ids=lambda path: path.stem)
def test_of_the_convolutions_the_gates_of_the_state_alone_stay_float32(path: Path) -> None:
    """The gates' convolution of the features and that of the state are two then."""
    core = openvino.Core()
    before, after = convolutions(core, read(core, path)), convolutions(core, states_in_float32(openvino, core, read(core, path)))
    assert len(before) > 6 and set(before) == {"bf16"}
    assert after == [*before, "f32"]


@pytest.mark.parametrize("path", STATELESS, ids=lambda path: path.stem)
def test_a_graph_without_a_state_is_left_alone(path: Path) -> None:
    core = openvino.Core()
    model = core.read_model(path)
    assert states_in_float32(openvino, core, model) is model


@pytest.mark.parametrize("path", STATEFUL, ids=lambda path: path.stem)
def test_in_float32_it_is_the_same_graph(path: Path) -> None:
    core, rng = openvino.Core(), np.random.default_rng(0)
    given: dict[str, np.ndarray] = {}
    for port in read(core, path).inputs:
        plane = port.get_element_type() == openvino.Type.u8
        given[port.any_name] = rng.integers(0, 256, port.shape, np.uint8) if plane else rng.normal(size=port.shape).astype(np.float32)
    pictures = [
        core.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})(given).to_dict()
        for model in (read(core, path), states_in_float32(openvino, core, read(core, path)))
    ]
    before, after = ({port.any_name: values for port, values in picture.items()} for picture in pictures)
    assert before.keys() == after.keys() > {"y_up", "u_up", "v_up", "state_sum"}
    for name, values in before.items():  # but for the order of the gates' sums
        difference = np.abs(values.astype(np.float32) - after[name])
        if values.dtype == np.uint8:
            assert difference.max() <= 1 and np.count_nonzero(difference) < 1e-3 * difference.size, name
        else:
            assert difference.max() < 1e-5, name


def test_what_a_state_does_not_come_through_or_does_not_leave_by_is_not_on_its_way() -> None:
    core = openvino.Core()
    plane, state = ops.parameter([1, 4, 8, 8], np.uint8, name="plane"), ops.parameter([1, 4, 8, 8], np.float32, name="state")
    tripled = ops.multiply(ops.convert(plane, "f32"), ops.constant(np.float32(3)))
    total = ops.add(tripled, state)
    picture = ops.convert(ops.sqrt(total), "u8")
    marked = states_in_float32(openvino, core, openvino.Model([total, picture], [plane, state], "small"))
    kinds = [
        (node.get_type_name(), any(key.startswith(("DisablePrecision", "precise")) for key, _ in node.get_rt_info().items()))
        for node in marked.get_ordered_ops()
    ]
    assert [kind for kind, is_kept in kinds if is_kept] == ["Add"]
    assert [kind for kind, _ in kinds].count("Convert") == 2


def gates(channels: int | openvino.Dimension, *, weight: Any = None) -> Any:
    """A state of 4 channels from one convolution of an input's channels beside it."""
    plane = ops.parameter(openvino.PartialShape([1, channels, 8, 8]), np.uint8, name="plane")
    state = ops.parameter([1, 4, 8, 8], np.float32, name="state")
    joined = ops.concat([ops.convert(plane, "f32"), state], 1)
    kernel = ops.constant(np.random.default_rng(0).normal(size=(4, 6, 3, 3)).astype(np.float32)) if weight is None else weight
    total = ops.convolution(joined, kernel, [1, 1], [1, 1], [1, 1], [1, 1])
    return openvino.Model([ops.sigmoid(total)], [plane, state], "gates")


@pytest.mark.parametrize("channels", [2, openvino.Dimension(-1)], ids=["known", "unknown"])
def test_what_cannot_be_taken_apart_is_kept_whole(channels: int | openvino.Dimension) -> None:
    core = openvino.Core()
    model = states_in_float32(openvino, core, gates(channels))
    kinds = [node.get_type_name() for node in model.get_ordered_ops()]
    assert (kinds.count("Convolution"), kinds.count("Concat")) == ((2, 0) if channels == 2 else (1, 1))
    core.compile_model(model, "CPU")


@pytest.mark.parametrize("name", ["twice", "a\x01b", "<&\"'>"])
def test_operations_of_any_name_are_told_from_each_other(name: str) -> None:
    core = openvino.Core()
    model = gates(2)
    for node in model.get_ordered_ops():
        if node.get_type_name() in ("Convert", "Sigmoid"):
            node.set_friendly_name(name)
    marked = {
        node.get_type_name(): any(key.startswith(("DisablePrecision", "precise")) for key, _ in node.get_rt_info().items())
        for node in states_in_float32(openvino, core, model).get_ordered_ops()
    }
    assert marked["Sigmoid"] and marked["Add"] and not marked["Convert"]
