"""What footage tells of a network before and after it is brought to 8 bits: how far its channels reach, and what is lost in the mean."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import numpy_helper

from client.frames import Frame
from model.hard_cases import lines, noise, text

SMALLEST = 0.01  # of the largest channel: what is nearly dead is not blown up any further
RATIOS = np.geomspace(0.05, 1, 30)  # of the negative end of a range to its positive one
Made = tuple[Callable[[int, int, int], Iterator[Frame]], int, int]
# Few clips have features as large as letters, one-pixel lines and stripes of any colours make them (noise two samples wide is
# stripes, as the edges go on): cut off there, lines came out 36 codes wrong.
MADE: tuple[Made, ...] = ((lines, 160, 96), (text, 160, 96), (noise, 160, 96), (noise, 160, 2), (noise, 2, 96))
MADE_FRAMES = 16

Array = NDArray[np.float64]
Feeds = dict[str, NDArray[np.generic]]  # what a graph takes, by name


def observed(model: onnx.ModelProto, tensors: list[str], inputs: Iterable[Feeds]) -> Iterator[dict[str, NDArray[np.float32]]]:
    """The named tensors of the graph for each of the inputs."""
    if not tensors:
        return
    opened = onnx.ModelProto()
    opened.CopyFrom(model)
    opened.graph.output.extend(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None) for name in tensors)
    session = onnxruntime.InferenceSession(opened.SerializeToString(), providers=["CPUExecutionProvider"])
    for feeds in inputs:
        yield dict(zip(tensors, session.run(tensors, feeds), strict=True))


def even_channels(model: onnx.ModelProto, inputs: Iterable[Feeds]) -> None:
    """Scale the channels between convolutions that a leaky ReLU joins, in place; the network computes what it did.

    A leaky ReLU of t x is t times that of x, for t > 0, so a channel's weights and bias may be multiplied by what the next layer's are
    divided by ("cross-layer equalization", Nagel et al. 2019, section 4.1). Here every channel comes to reach as far as any other over
    `inputs`: in 8 bits with one step for a tensor those of small values have no use of most of its range.
    """
    convs = {node.output[0]: node for node in model.graph.node if node.op_type == "Conv"}
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in convs.values():
        readers.setdefault(node.input[0], []).append(node)
    read = Counter(name for node in model.graph.node for name in node.input)
    joined = [
        (convs[node.input[0]], node.output[0], readers[node.output[0]])
        for node in model.graph.node
        if node.op_type == "LeakyRelu" and node.input[0] in convs and node.output[0] in readers
        if read[node.input[0]] == 1 and read[node.output[0]] == len(readers[node.output[0]])  # nothing else sees the scale
    ]
    names = [features for _, features, _ in joined]
    lowest: dict[str, Array] = dict.fromkeys(names, np.zeros(1))
    highest = dict(lowest)
    for values in observed(model, names, inputs):
        for name, features in values.items():
            lowest[name] = np.minimum(lowest[name], features.min((0, 2, 3)))
            highest[name] = np.maximum(highest[name], features.max((0, 2, 3)))
    tensors = {tensor.name: tensor for tensor in model.graph.initializer}
    for before, name, behind in joined:
        weights = [numpy_helper.to_array(tensors[conv.input[1]]) for conv in behind]
        reach = _even(lowest[name], highest[name], sum(np.square(weight, dtype=np.float64).sum((0, 2, 3)) for weight in weights))
        for tensor, factors in (
            (before.input[1], 1 / reach[:, None, None, None]),
            (before.input[2], 1 / reach),
            *((conv.input[1], reach[None, :, None, None]) for conv in behind),
        ):
            scaled = (numpy_helper.to_array(tensors[tensor]) * factors).astype(np.float32)
            tensors[tensor].CopyFrom(numpy_helper.from_array(scaled, tensor))


def mean_difference(model: onnx.ModelProto, other: onnx.ModelProto, tensor: str, inputs: Iterable[Feeds]) -> Array:
    """The mean of a tensor (1, C, H, W) in `model` less that in `other`, for each channel, over all positions of all inputs."""
    total, positions = np.zeros(1), 0
    for ours, theirs in zip(observed(model, [tensor], inputs), observed(other, [tensor], inputs), strict=True):
        total = total + (ours[tensor] - theirs[tensor]).sum((0, 2, 3), dtype=np.float64)
        positions += ours[tensor][0, 0].size
    return total / positions


def _even(low: Array, high: Array, gains: Array) -> Array:
    """What each channel is divided by, so that all lie in [-r, 1], each touching an end.

    r is what makes the error behind least: a step is proportional to 1 + r, and channel i's error to its divisor and its `gains`,
    the sum of its squared weights there.
    """
    least = SMALLEST * (max(-low.min(), high.max()) or 1)
    ways = [np.maximum(np.maximum(high, -low / r), least) for r in RATIOS]
    errors = [(1 + r) ** 2 * (np.square(divisors) @ gains) for r, divisors in zip(RATIOS, ways, strict=True)]
    best: Array = ways[int(np.argmin(errors))]
    return best
