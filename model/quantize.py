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

# Not the gates, whose error the state would keep; not what interpolates, which makes the code values themselves; and not a head
# whose base is apart: a residual of rare large values in 8 bits is what lost most, and such a head is a twentieth of the work.
QUANTIZED = re.compile(r"network\.(stem|blocks\.\d+\.(conv|0)|head\.features)\.weight")
CALIBRATION_FRAMES = 8

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
    split_merged_head(model.graph, upscaler.spec)
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
            )
        quantized = onnx.load(whole)
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


def split_merged_head(graph: onnx.GraphProto, spec: ModelSpec) -> None:
    """Undo in place what `model.network.MergedHead` joined, if there is one: 8 bits do for the residual, not for the interpolation."""
    weights = {tensor.name: tensor for tensor in graph.initializer}
    made_by = {output: node for node in graph.node for output in node.output}
    head = next((node for node in graph.node if node.op_type == "Conv" and node.input[1] == "network.head.conv.weight"), None)
    if head is None:
        return
    join = made_by[head.input[0]]
    pad = made_by[join.input[0]]
    weight = numpy_helper.to_array(weights[head.input[1]])
    channels = spec.card["network"]["channels"]
    features, cells = np.split(weight, [channels], axis=1)
    for name, part in (("features", features), ("cells", cells)):
        graph.initializer.append(numpy_helper.from_array(part.copy(), f"network.head.{name}.weight"))
    parts = [
        helper.make_node("Conv", [pad.input[0], "network.head.features.weight"], ["head_features"], name="head_features", pads=[1] * 4),
        helper.make_node("Conv", [join.input[1], "network.head.cells.weight", head.input[2]], ["head_cells"], name="head_cells"),
        helper.make_node("Add", ["head_features", "head_cells"], list(head.output), name="head"),
    ]
    gone = (pad.name, join.name)
    nodes = [part for node in graph.node if node.name not in gone for part in (parts if node.name == head.name else [node])]
    del graph.node[:]
    graph.node.extend(nodes)
    used = {name for node in graph.node for name in node.input}
    for tensor in [tensor for tensor in graph.initializer if tensor.name not in used]:
        graph.initializer.remove(tensor)


@contextmanager
def _quiet_quantizer() -> Iterator[None]:
    """Keeps out the advice to optimize the graph first: the exporter has done that."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
