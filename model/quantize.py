"""int8 artifacts of float32 ones: 8-bit weights and features, calibrated on footage (static QDQ, by ONNX Runtime's quantizer)."""

from __future__ import annotations

import json
import logging
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

from client.artifact import ModelSpec
from client.errors import InputError, ModelError
from client.frames import Frame
from client.upscaler import OnnxUpscaler, copy_padded, plane_shapes
from client.video import read_frames
from model.lean import ARCHITECTURE, CELL

# Not the gates, whose error the state would keep; not what interpolates, which makes the code values themselves; and not a head
# whose base is apart: a residual of rare large values in 8 bits is what lost most, and such a head is a twentieth of the work.
QUANTIZED = re.compile(r"network\.(stem|blocks\.\d+(\.conv)?|head\.features)\.weight")
CALIBRATION_FRAMES = 8

CODES, MIDDLE = "codes_about_zero", 128
RESIDUAL = "residual"  # what the head makes of the features, in codes

JOINING = ("Relu", "LeakyRelu", "Add")


def quantize(artifact: Path, path: Path, clips: Sequence[Path], *, name: str, frames: int = CALIBRATION_FRAMES) -> dict[str, Any]:
    """Write an int8 artifact; its card, which is returned, says what it was made from and calibrated on.

    `clips` are videos of the artifact's input, low resolution and compressed as they will be; the ranges of the features are
    the smallest and the largest value in the first `frames` frames of each, the state carried by the float network. Weights
    are symmetric, a scale for each output channel, features unsigned with one scale and zero point for a tensor: signed ones
    take twice as long in both runtimes. Raises ModelError for an artifact that is not a float32 network of ours and InputError
    for a clip without frames.
    """
    upscaler = OnnxUpscaler(artifact)
    model = onnx.load(artifact)
    if upscaler.spec.precision != "float32":
        raise ModelError(f"{artifact} is {upscaler.spec.precision} already: quantize the float32 artifact")
    split_carried_cells(model.graph, upscaler.spec)
    nodes = _quantized_nodes(model.graph)
    if not nodes:
        raise ModelError(f"{artifact} has no layer that is quantized: it is no GameSR network")
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    footage = _Footage(upscaler, clips, frames)
    with tempfile.TemporaryDirectory(prefix="gamesr-quantize-") as folder:
        whole = Path(folder) / "int8.onnx"
        with _quiet_quantizer():
            quantize_static(
                model,
                whole,
                footage,
                op_types_to_quantize=["Conv", *JOINING],
                nodes_to_quantize=nodes,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                extra_options={"TensorQuantOverrides": exact_codes(model.graph)},
            )
        quantized = onnx.load(whole)
    leave_float(quantized.graph, RESIDUAL)
    card = {**upscaler.spec.card, "quantized_from": upscaler.spec.sha256, "calibration": footage.played}
    helper.set_model_props(quantized, {**metadata, "name": name, "precision": "int8", "card": json.dumps(card)})
    onnx.checker.check_model(quantized, full_check=True)
    partial = path.with_suffix(f".{os.getpid()}.partial")
    onnx.save(quantized, str(partial))
    partial.replace(path)
    return card


class _Footage(CalibrationDataReader):  # type: ignore[misc]
    """The inputs of the graph, frame by frame: planes, and the state that the float network has come to.

    `played` says which clips are through, and how many of their frames that were.
    """

    def __init__(self, upscaler: OnnxUpscaler, clips: Sequence[Path], frames: int) -> None:
        self.played: list[str] = []
        self._inputs = self._play(upscaler, clips, frames)

    def get_next(self) -> dict[str, NDArray[np.generic]] | None:
        return next(self._inputs, None)

    def _play(self, upscaler: OnnxUpscaler, clips: Sequence[Path], most: int) -> Iterator[dict[str, NDArray[np.generic]]]:
        for clip in clips:
            state, count = None, 0
            for frame in islice(read_frames(clip), most):
                state = state or upscaler.initial_state(frame.height, frame.width)
                remembered = [tensor.copy() for tensor in state.tensors()]
                yield {**_planes(frame, upscaler.spec), **{s.input: t for s, t in zip(upscaler.spec.state, remembered, strict=True)}}
                _, state = upscaler.step(frame, state)
                count += 1
            if state is None:
                raise InputError(f"no frame of {clip} could be decoded")
            self.played.append(f"{clip.name} ({count} frames)")


def _planes(frame: Frame, spec: ModelSpec) -> dict[str, NDArray[np.generic]]:
    shapes = plane_shapes(spec.padded(frame.height), spec.padded(frame.width))
    padded = [np.empty(shape, np.uint8) for shape in shapes]
    for plane, target in zip((frame.y, frame.u, frame.v), padded, strict=True):
        copy_padded(plane, target)
    return {name: plane[None, None] for name, plane in zip("yuv", padded, strict=True)}


def _quantized_nodes(graph: onnx.GraphProto) -> list[str]:
    """Names of the convolutions that `QUANTIZED` names, and of what only ever joins their outputs.

    A residual stream then stays in 8 bits: in ONNX Runtime that takes three quarters of the time of going back and forth.
    """
    nodes: list[str] = []
    eight_bits: set[str] = set()
    for node in graph.node:
        if (node.op_type == "Conv" and QUANTIZED.fullmatch(node.input[1])) or (
            node.op_type in JOINING and eight_bits.issuperset(node.input)
        ):
            nodes.append(node.name)
            eight_bits.update(node.output)
    return nodes


def split_carried_cells(graph: onnx.GraphProto, spec: ModelSpec) -> None:
    """Take the picture's cells out of the layers of a `model.lean` network, in place: 8 bits do for features, not for codes beside them.

    The head becomes one of features and one of cells, cut to what the layers would have left of them. Any other network stays as it is.
    """
    if spec.card.get("network", {}).get("architecture") != ARCHITECTURE:
        return
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    stem, *blocks, head = (node for node in graph.node if node.op_type == "Conv")
    features = numpy_helper.to_array(tensors[stem.input[1]]).shape[0] - CELL
    for conv in (stem, *blocks):
        inputs = CELL if conv is stem else features
        for name, part in ((conv.input[1], np.s_[:features, :inputs]), (conv.input[2], np.s_[:features])):
            tensors[name].CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensors[name])[part].copy(), name))
    # Codes about zero: what 8 bits do to a weight then counts for detail alone, not for how bright a picture is.
    bias = tensors[stem.input[2]]
    gain = numpy_helper.to_array(tensors[stem.input[1]]).sum((1, 2, 3), dtype=np.float64)
    bias.CopyFrom(numpy_helper.from_array((numpy_helper.to_array(bias) + MIDDLE * gain).astype(np.float32), bias.name))
    weight = numpy_helper.to_array(tensors[head.input[1]])
    cut = 1 + len(blocks)
    new = {
        "network.head.features.weight": weight[:, :features],
        "network.head.cells.weight": weight[:, features:],
        "middle": np.array(MIDDLE, np.float32),
        "starts": np.array([cut, cut]),
        "ends": np.array([-cut, -cut]),
        "axes": np.array([2, 3]),
    }
    graph.initializer.extend(numpy_helper.from_array(array.copy(), name) for name, array in new.items())
    graph.initializer.remove(tensors[head.input[1]])
    cells, source = stem.input[0], head.input[0]
    stem.input[0] = CODES
    before = {stem.name: [helper.make_node("Sub", [cells, "middle"], [CODES], name=CODES), stem]}
    instead = {
        head.name: [
            helper.make_node("Conv", [source, "network.head.features.weight", head.input[2]], [RESIDUAL], name=RESIDUAL),
            helper.make_node("Slice", [cells, "starts", "ends", "axes"], ["head_source"], name="head_source"),
            helper.make_node("Conv", ["head_source", "network.head.cells.weight"], ["head_cells"], name="head_cells"),
            helper.make_node("Add", [RESIDUAL, "head_cells"], list(head.output), name="head"),
        ]
    }
    nodes = [part for node in graph.node for part in {**before, **instead}.get(node.name, [node])]
    del graph.node[:]
    graph.node.extend(nodes)
    del graph.value_info[:]  # whose shapes are those of the wider layers


def exact_codes(graph: onnx.GraphProto) -> dict[str, list[dict[str, Any]]]:
    """What the quantizer is told of the codes about zero, where there are any: each has a number of its own."""
    there = any(CODES in node.output for node in graph.node)
    return {CODES: [{"scale": np.array(1, np.float32), "zero_point": np.array(MIDDLE, np.uint8)}]} if there else {}


def leave_float(graph: onnx.GraphProto, tensor: str) -> None:
    """Take a tensor's 8 bits away, in place: with one step for the residual of Y, U and V, half a code of U would be lost."""
    down = next((node for node in graph.node if node.op_type == "QuantizeLinear" and node.input[0] == tensor), None)
    if down is None:
        return
    up = next(node for node in graph.node if node.op_type == "DequantizeLinear" and node.input[0] == down.output[0])
    for node in graph.node:
        node.input[:] = [tensor if name == up.output[0] else name for name in node.input]
    graph.node.remove(down)
    graph.node.remove(up)


@contextmanager
def _quiet_quantizer() -> Iterator[None]:
    """Keeps out the advice to optimize the graph first: the exporter has done that."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
