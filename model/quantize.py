"""int8 artifacts of float32 ones: 8-bit weights and features, calibrated on footage (static QDQ, by ONNX Runtime's quantizer)."""

from __future__ import annotations

import copy
import json
import logging
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

from client.artifact import ModelSpec, load_session
from client.errors import ModelError
from client.frames import Frame, plane_shapes
from client.upscaler import copy_padded
from client.video import VideoSource
from client.whole_frames import whole_frames
from model.artifact_files import Page, write_artifact
from model.artifact_weights import network_of_artifact
from model.calibration import MADE, MADE_FRAMES, Feeds, Made, even_channels, mean_difference
from model.catalogue import described_network
from model.export import export_network
from model.lean import ARCHITECTURE, MIDDLE, Lean
from model.seven_bits import settle_weights

# Not the gates, whose error the state would keep; not what interpolates, which makes the code values themselves; and not a head
# whose base is apart: a residual of rare large values in 8 bits is what lost most, and such a head is a twentieth of the work.
QUANTIZED = re.compile(r"network\.(stem|blocks\.\d+(\.conv)?|(chroma_)?head\.features)\.weight")
HEAD_FEATURES = re.compile(r"network\.(chroma_)?head\.features\.weight")
CALIBRATION_FRAMES = 8

JOINING = ("Relu", "Add")


def quantize(
    artifact: Path,
    path: Path,
    clips: Sequence[Path],
    *,
    name: str,
    frames: int = CALIBRATION_FRAMES,
    made_frames: int = MADE_FRAMES,
    page: Page | None = None,
) -> None:
    """Write an int8 artifact, whose card says what it was made from and calibrated on; `page` makes what lies beside it.

    `clips` are videos of the artifact's input, low resolution and compressed as they will be; the ranges of the features are
    the smallest and the largest value in the first `frames` frames of each, and in `made_frames` frames of each of `MADE`. Weights
    are symmetric, a scale for each output channel, of 7 bits (`model.seven_bits`); features unsigned with one scale and zero point for
    a tensor (signed ones take twice as long in both runtimes), of which every channel is made to use all (`even_channels`). What 8
    bits do to the mean of the clips' pictures is taken back in a `model.lean` network. Raises ModelError for an artifact that is not a
    float32 network of ours and InputError for a clip without frames.
    """
    _, spec = load_session(artifact, "cpu", 1)
    if spec.precision != "float32":
        raise ModelError(f"{artifact} is {spec.precision} already: quantize the float32 artifact")
    model, residuals = with_cells_apart(artifact)
    nodes = _quantized_nodes(model.graph)
    if not nodes:
        raise ModelError(f"{artifact} has no layer that is quantized: it is no GameSR network")
    left_float = [*residuals, *(node.input[0] for node in model.graph.node if node.op_type == "LeakyRelu")]
    metadata = {entry.key: entry.value for entry in onnx.load(artifact).metadata_props}
    footage = _Footage(spec, clips, frames, MADE, made_frames)
    even_channels(model, footage)
    with tempfile.TemporaryDirectory(prefix="gamesr-quantize-") as folder:
        whole = Path(folder) / "int8.onnx"
        with _quiet_quantizer():
            quantize_static(
                copy.deepcopy(model),  # whose tensors it moves to files
                whole,
                footage,
                op_types_to_quantize=["Conv", *JOINING],
                nodes_to_quantize=nodes,
                per_channel=True,
                reduce_range=True,  # weights up to 64
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                extra_options={"TensorQuantOverrides": _exact_codes(model.graph) if residuals else {}},
            )
        quantized = onnx.load(whole)
    for tensor in left_float:
        leave_float(quantized.graph, tensor)
    settle_weights(model, quantized, lambda: _Footage(spec, clips, frames))
    for residual, bias in residuals.items():
        lost = mean_difference(model, quantized, residual, _Footage(spec, clips, frames))
        tensor = next(tensor for tensor in quantized.graph.initializer if tensor.name == bias)
        tensor.CopyFrom(numpy_helper.from_array((numpy_helper.to_array(tensor) + lost).astype(np.float32), bias))
    runs = json.loads(next((entry.value for entry in model.metadata_props if entry.key == "card"), "{}"))
    counts = {key: runs[key] for key in ("parameters", "macs_540p") if key in runs}  # of the form that was brought to 8 bits
    card = {**spec.card, **counts, "quantized_from": spec.sha256, "calibration": footage.played}
    helper.set_model_props(quantized, {**metadata, "name": name, "precision": "int8", "card": json.dumps(card)})
    onnx.checker.check_model(quantized, full_check=True)
    write_artifact(quantized, path, page and page(name, spec.scale, card))


class _Footage(CalibrationDataReader):  # type: ignore[misc]
    """The inputs of the graph, frame by frame; anew whenever gone through.

    The state is zeros with every frame: what comes in 8 bits lies before the gates and does not depend on it.
    `played` says which clips are through, and how many of their frames that were.
    """

    def __init__(self, spec: ModelSpec, clips: Sequence[Path], most: int, made: Sequence[Made] = (), made_frames: int = 0) -> None:
        self.played: list[str] = []
        self._spec, self._clips, self._most, self._made, self._made_frames = spec, clips, most, made, made_frames
        self._inputs = iter(self)

    def get_next(self) -> Feeds | None:
        """What the quantizer asks for: once through."""
        return next(self._inputs, None)

    def __iter__(self) -> Iterator[Feeds]:
        self.played.clear()
        for clip in self._clips:
            count = 0
            with VideoSource(clip) as source:
                for frame in islice(whole_frames(source, "is damaged: nothing can be calibrated on it"), self._most):
                    yield _feeds(frame, self._spec)
                    count += 1
            self.played.append(f"{clip.name} ({count} frames)")
        for made, width, height in self._made:
            for frame in made(width, height, self._made_frames):
                yield _feeds(frame, self._spec)
            self.played.append(f"made {made.__name__}, {width}x{height} ({self._made_frames} frames)")


def _feeds(frame: Frame, spec: ModelSpec) -> Feeds:
    height, width = spec.padded(frame.height), spec.padded(frame.width)
    padded = [np.empty(shape, np.uint8) for shape in plane_shapes(height, width)]
    for plane, target in zip((frame.y, frame.u, frame.v), padded, strict=True):
        copy_padded(plane, target)
    state = {s.input: np.zeros((1, s.channels, height // s.divisor, width // s.divisor), s.dtype) for s in spec.state}
    return {**{name: plane[None, None] for name, plane in zip("yuv", padded, strict=True)}, **state}


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


def with_cells_apart(artifact: Path) -> tuple[onnx.ModelProto, dict[str, str]]:
    """The float32 graph that is brought to 8 bits: of a `model.lean` network with the picture's cells beside its layers, about zero.

    8 bits do for features, not for codes beside them; about zero, what they do to a weight counts for detail alone, not for how bright
    a picture is. With it the tensors that heads make of the features, in codes, and for each the bias that can give back what 8 bits
    take from it in the mean (Nagel et al. 2019, section 4.2). The graph of any other network stays as it is, and has none.
    """
    model = onnx.load(artifact)
    described = load_session(artifact, "cpu", 1)[1].card.get("network", {})
    if described.get("architecture") != ARCHITECTURE:
        return model, {}
    network, deployed = described_network(described), network_of_artifact(artifact)
    assert isinstance(network, Lean) and isinstance(deployed, Lean)
    if network.config.carried:
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(0)  # there is chance in a training form; with the same, the same artifact comes of the same input
            network.load_deployed(deployed)
        with tempfile.TemporaryDirectory(prefix="gamesr-quantize-") as folder:
            apart = Path(folder) / "apart.onnx"
            export_network(network.apart(), apart, name=artifact.stem, card={})
            model = onnx.load(apart)
    heads = [node for node in model.graph.node if node.op_type == "Conv" and HEAD_FEATURES.fullmatch(node.input[1])]
    return model, {head.output[0]: head.input[1].replace("features.weight", "cells.bias") for head in heads}


def _exact_codes(graph: onnx.GraphProto) -> dict[str, list[dict[str, Any]]]:
    """What the quantizer is told of the codes about zero that the first convolution reads: each has a number of its own."""
    codes = next(node for node in graph.node if node.op_type == "Conv").input[0]
    return {codes: [{"scale": np.array(1, np.float32), "zero_point": np.array(MIDDLE, np.uint8)}]}


def leave_float(graph: onnx.GraphProto, tensor: str) -> None:
    """Take a tensor's 8 bits away, in place.

    With one step for the residual of Y, U and V half a code of U would be lost. Before a leaky ReLU the negative side is ten times as
    wide as behind it and takes most of the 256 steps; OpenVINO fuses the ReLU into the convolution, so they would cost time besides.
    """
    down = next((node for node in graph.node if node.op_type == "QuantizeLinear" and node.input[0] == tensor), None)
    if down is None:
        return
    up = next(node for node in graph.node if node.op_type == "DequantizeLinear" and node.input[0] == down.output[0])
    for node in graph.node:
        node.input[:] = [tensor if name == up.output[0] else name for name in node.input]
    graph.node.remove(down)
    graph.node.remove(up)
    used = {name for node in graph.node for name in node.input}
    for parameter in [t for t in graph.initializer if t.name in down.input and t.name not in used]:
        graph.initializer.remove(parameter)


@contextmanager
def _quiet_quantizer() -> Iterator[None]:
    """Keeps out the advice to optimize the graph first: the exporter has done that."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
