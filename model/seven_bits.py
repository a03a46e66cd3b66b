"""The weights of an int8 artifact: 7 bits, rounded so that what one of them is off by the others take back.

7 bits are right on every processor (`client.int8_weights`) and half as fine as 8: rounding each weight to the nearest loses up to 0.1 dB
by it. But a layer's inputs go together, neighbours in a picture above all. So weights are rounded one after the other, and each time
those still to come make up for it as far as what the layer reads allows (GPTQ, Frantar et al. 2023, equations 2 and 3). What that
leaves in the mean goes into the bias.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from client.int8_weights import MOST
from model.calibration import Feeds, observed

SHARE = 1 / 8  # of the places of each input that are looked at
DAMPING = 0.01  # of the mean square of what is read: what hardly varies in these inputs is not made to pay for the rest

Array = NDArray[np.float64]


def settle_weights(model: onnx.ModelProto, quantized: onnx.ModelProto, inputs: Callable[[], Iterable[Feeds]]) -> None:
    """Round the weights of every layer of `quantized` that is in 8 bits anew, in place, for the least change of what it gives.

    `quantized` is `model` brought to 8 bits by ONNX Runtime's quantizer with `reduce_range`: an int8 tensor (O, C, H, W) of weights with
    a scale for each output. `inputs` gives the same inputs of both whenever it is called. Layers come first to last, so that each is
    fitted to what those before it really give.
    """
    exact = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    tensors = {tensor.name: tensor for tensor in quantized.graph.initializer}
    raised = {node.output[0]: node.input for node in quantized.graph.node if node.op_type == "DequantizeLinear"}
    read: dict[str, tuple[Array, Array]] = {}
    for conv in [node for node in quantized.graph.node if node.op_type == "Conv" and node.input[1] in raised]:
        codes, scale = (tensors[name] for name in raised[conv.input[1]][:2])
        weights = exact[codes.name.removesuffix("_quantized")].astype(np.float64)
        if conv.input[0] not in read:
            read[conv.input[0]] = _mean_and_covariance(quantized, conv.input[0], weights.shape[2:], inputs())
        mean, covariance = read[conv.input[0]]
        flat, steps = weights.reshape(len(weights), -1), numpy_helper.to_array(scale).astype(np.float64)[:, None]
        rounded = settled(flat / steps, covariance)
        codes.CopyFrom(numpy_helper.from_array(rounded.reshape(weights.shape).astype(np.int8), codes.name))
        if len(conv.input) > 2:  # else there is a bias behind the layer, which `mean_difference` corrects
            bias, step = (tensors[name] for name in raised[conv.input[2]][:2])
            lost = np.round((flat - rounded * steps) @ mean / numpy_helper.to_array(step))
            bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(bias) + lost.astype(np.int32), bias.name))


def settled(weights: Array, covariance: Array) -> Array:
    """Whole numbers up to MOST for weights (O, F), for inputs of this covariance (F, F): the largest variance first."""
    order = np.argsort(-np.diag(covariance), kind="stable")
    damped = covariance[np.ix_(order, order)] + (DAMPING * np.trace(covariance) / len(order) or 1) * np.eye(len(order))
    answers = np.linalg.cholesky(np.linalg.inv(damped)).T  # a row: how those that follow make up for one
    left, rounded = weights[:, order], np.empty_like(weights)
    for index, row in enumerate(answers):
        rounded[:, order[index]] = np.clip(np.round(left[:, index]), -MOST, MOST)
        off = (left[:, index] - rounded[:, order[index]]) / row[index]
        left[:, index:] -= off[:, None] * row[None, index:]
    return rounded


def _mean_and_covariance(model: onnx.ModelProto, tensor: str, kernel: tuple[int, ...], inputs: Iterable[Feeds]) -> tuple[Array, Array]:
    """Of the windows (C, H, W) that a convolution of a kernel (H, W) reads of a tensor, every input counting as much."""
    places = np.random.default_rng(0)
    means: list[Array] = []
    products: list[Array] = []
    for values in observed(model, [tensor], inputs):
        windows = np.lib.stride_tricks.sliding_window_view(values[tensor][0], kernel, axis=(1, 2))
        rows, columns = windows.shape[1:3]
        chosen = places.permutation(rows * columns)[: max(1, round(SHARE * rows * columns))]
        sample = windows[:, chosen // columns, chosen % columns].swapaxes(0, 1).reshape(len(chosen), -1).astype(np.float64)
        means.append(sample.mean(0))
        products.append(sample.T @ sample / len(chosen))
    mean = np.mean(means, 0)
    return mean, np.mean(products, 0) - np.outer(mean, mean)
