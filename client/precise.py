"""What lies on a state's way through a graph, computed in float32 by OpenVINO whatever the rest is computed in."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np

# What says so of an operation in OpenVINO's own format, the second name before 2026.4. What it does not know it passes over.
MARKS = (
    {"name": "DisablePrecisionConversion", "version": "0", "value": "dynamic:f16"},
    {"name": "precise", "version": "0"},
)


def states_in_float32(ov: ModuleType, core: Any, model: Any) -> Any:
    """An `openvino.Model` of which every operation between a state that comes in and one that goes out stays float32; the same if none.

    An error there comes back with every frame: in bfloat16, which rounds what goes into an operation and what comes out of it, a state
    does not come to rest in a still. What a convolution makes of anything but the state is an operation of its own then and
    stays fast: half of the gates' work. Python cannot mark an operation, so the model is written in OpenVINO's format, marked and
    read again. `model` is no longer to be used.
    """
    _take_apart(ov, model)
    _name_apart(model)
    names = {node.get_friendly_name() for node in _between_states(model)}
    if not names:
        return model
    with tempfile.TemporaryDirectory(prefix="gamesr-") as folder:
        graph, weights = Path(folder) / "model.xml", Path(folder) / "model.bin"
        ov.serialize(model, graph, weights)
        tree = ElementTree.fromstring(graph.read_bytes())
        tensors = np.fromfile(weights, np.uint8)
    for layer in tree.iter("layer"):
        if layer.get("name") in names:
            notes = layer.find("rt_info")
            if notes is None:
                notes = ElementTree.Element("rt_info")
                layer.insert(1 if layer.find("data") is not None else 0, notes)
            for mark in MARKS:
                ElementTree.SubElement(notes, "attribute", mark)
    return core.read_model(model=ElementTree.tostring(tree), weights=ov.Tensor(tensors))


def _take_apart(ov: ModuleType, model: Any) -> None:
    """Of a convolution of a state beside other channels make one of each, added up."""
    ops = ov.opset13
    for node in [node for node in model.get_ordered_ops() if node.get_type_name() == "Convolution"]:
        joined, weight = (node.input_value(index).get_node() for index in (0, 1))
        if (joined.get_type_name(), weight.get_type_name()) != ("Concat", "Constant") or joined.get_attributes()["axis"] != 1:
            continue
        parts = joined.input_values()
        reads_a_state = any(part.get_node().get_type_name() == "Parameter" for part in parts)
        if not reads_a_state or any(part.get_partial_shape()[1].is_dynamic for part in parts):
            continue
        ends = np.cumsum([part.get_partial_shape()[1].get_length() for part in parts])
        how = {name: node.get_attributes()[name] for name in ("strides", "pads_begin", "pads_end", "dilations", "auto_pad")}
        pieces = np.split(weight.get_data(), ends[:-1], 1)
        convolved = [ops.convolution(part, ops.constant(piece.copy()), **how) for part, piece in zip(parts, pieces, strict=True)]
        node.output(0).replace(functools.reduce(ops.add, convolved).output(0))


def _name_apart(model: Any) -> None:
    """Give another name to operations that share one, as an artifact's may, or whose name XML does not hold."""
    taken: set[str] = set()
    for index, node in enumerate(model.get_ordered_ops()):
        name = node.get_friendly_name()
        if name in taken or not name.isprintable():
            node.set_friendly_name(f"operation {index}")
        taken.add(node.get_friendly_name())


def _between_states(model: Any) -> set[Any]:
    """Operations that depend on an input of floats and that an output of four axes of floats depends on: an artifact's states."""
    inputs = [value.get_node() for value in model.inputs if value.get_element_type().is_real()]
    outputs = [value.get_node() for value in model.outputs if value.get_element_type().is_real() and len(value.get_partial_shape()) == 4]
    return _reached(inputs, _users) & _reached(outputs, _sources)


def _reached(start: Iterable[Any], onward: Callable[[Any], Iterable[Any]]) -> set[Any]:
    """Every node that can be come to from `start`, these left out."""
    found: set[Any] = set()
    todo = list(start)
    while todo:
        new = set(onward(todo.pop())) - found
        found |= new
        todo += new
    return found


def _users(node: Any) -> list[Any]:
    return [target.get_node() for output in node.outputs() for target in output.get_target_inputs()]


def _sources(node: Any) -> list[Any]:
    return [value.get_node() for value in node.input_values()]
