"""Networks and baselines as self-describing ONNX artifacts: uint8 planes and state in, uint8 planes and state out."""

from __future__ import annotations

import copy
import json
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn

from model.artifact_files import Page, write_artifact
from model.complexity import macs, parameter_count
from model.fsr1 import SHARPNESS_STOPS, Fsr1
from model.interpolation import MIDDLES, Interpolation, chroma_shift, shuffle_channels_last
from model.planes import Network, Planes, State
from model.reach import network_reach, reach

FORMAT_VERSION = "1"
OPSET = 20  # the first with Gelu as one operator: 15% of a frame's time on a CPU
FSR1_PASSES = {"easu": "EASU", "fsr1": f"EASU, then RCAS at {SHARPNESS_STOPS} stops"}
TRACED = (24, 32)  # the size at which a graph is traced, of any height and width afterwards
BASELINES = ("bicubic", "lanczos", *FSR1_PASSES)


def to_codes(plane: Tensor) -> Tensor:
    """Float code values to uint8: rounded half to even, clamped to 0..255."""
    return plane.round().clamp(0, 255).to(torch.uint8)


class Baseline(nn.Module):
    """Bicubic or Lanczos interpolation behind the artifact's contract; luma is centred, chroma left-sited.

    Rounding to uint8 comes before PixelShuffle, which then moves a quarter of the bytes.
    """

    def __init__(self, kernel: str, scale: int) -> None:
        super().__init__()
        self.luma = Interpolation(kernel, scale, 2)
        self.chroma = Interpolation(kernel, scale, 1, chroma_shift(scale))
        self.side = scale

    def forward(self, y: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.samples(Planes(y.float(), u.float(), v.float()), to_codes)

    def samples(self, frame: Planes, finish: Callable[[Tensor], Tensor] = lambda samples: samples) -> Planes:
        y, u, v = (plane - middle for plane, middle in zip(frame, MIDDLES, strict=True))
        luma = shuffle_channels_last(finish(self.luma(y) + MIDDLES[0]), 2 * self.side)
        chroma = shuffle_channels_last(finish(self.chroma(torch.cat((u, v))) + MIDDLES[1]), self.side)
        return Planes(luma, chroma[:1], chroma[1:])


class Fsr1Baseline(nn.Module):
    """FSR 1 behind the artifact's contract; with RCAS or, as `easu`, without."""

    def __init__(self, scale: int, *, sharpen: bool) -> None:
        super().__init__()
        self.fsr1 = Fsr1(scale, sharpen=sharpen)

    def forward(self, y: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        y, u, v = self.samples(Planes(y.float(), u.float(), v.float()))
        return to_codes(y), to_codes(u), to_codes(v)

    def samples(self, frame: Planes) -> Planes:
        return Planes(*self.fsr1(*frame))


class Frontend(nn.Module):
    """A network behind the artifact's contract: casts, rounding, clamping and the check of the state are part of the graph.

    `state_sum` is finite where all of the state is. It adds up means: a plain sum leaves float16 at 960x540.
    """

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, y: Tensor, u: Tensor, v: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        frame = Planes(*(p.to(self.network.weight.dtype) for p in (y, u, v)))
        planes, after = self.network.step(frame, State(*state) if state else None, to_codes)
        if after is None:
            return planes
        return (*planes, *after, after.h.mean() + after.c.mean())


def export_network(network: Network, path: Path, *, name: str, card: dict[str, Any], page: Page | None = None) -> None:
    """Fuse and write a network; `card` says where its weights come from, shape and counts are added; `page` makes what lies beside it.

    The counts are of the form that runs: its parameters, and `macs_540p`, the multiply-accumulates of a 960x540 frame.
    `network` itself is left as it is.
    """
    fused = copy.deepcopy(network).float().eval().deployed()
    state = fused.initial_state(1, *TRACED)
    parts = [] if state is None else list(zip(State._fields, state, strict=True))
    divisor = TRACED[0] // parts[0][1].shape[2] if parts else 1
    card = {
        **card,
        "network": network.description,
        "parameters": parameter_count(fused),
        "parameters_in_training": parameter_count(network),
        "macs_540p": macs(fused),
    }
    metadata = {
        "name": name,
        "scale": network.scale,
        "size_multiple": network.size_multiple,
        "precision": "float32",
        "state": [state_entry(part, tensor.shape[1], divisor) for part, tensor in parts],
        "reach": network_reach(copy.deepcopy(fused).double()),
        "card": card,
    }
    model = _traced(Frontend(fused), state, divisor, metadata)
    write_artifact(model, path, page and page(name, network.scale, card))


def export_baseline(kind: str, scale: int, path: Path, *, name: str) -> None:
    """Write `kind`, one of BASELINES, under a name; its card says what it computes, and there is no page beside it."""
    module: Baseline | Fsr1Baseline
    if kind in FSR1_PASSES:
        module = Fsr1Baseline(scale, sharpen=kind == "fsr1")
        card = {
            "algorithm": f"AMD FidelityFX Super Resolution 1.0: {FSR1_PASSES[kind]}, on BT.709 limited-range RGB",
            "note": "made for the shaders of a GPU: its time on a CPU is not its time on a GPU",
        }
    else:
        module = Baseline(kind, scale)
        card = {"interpolation": kind}
    far = reach(module.double().samples, 2)
    metadata = {"name": name, "scale": scale, "size_multiple": 2, "precision": "float32", "state": [], "reach": far, "card": card}
    write_artifact(_traced(module.float(), None, 1, metadata), path, None)


def state_entry(part: str, channels: int, divisor: int) -> dict[str, object]:
    return {"input": f"{part}_in", "output": f"{part}_out", "channels": channels, "divisor": divisor, "dtype": "float32"}


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Keeps out what torch's exporter says of torchvision, of its own deprecations and of axes that share a name."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _name_slopes(module: nn.Module, graph: onnx.GraphProto) -> None:
    """Call PReLU's slopes in the graph by their parameters' names, as every other weight is: the exporter shapes them anew, nameless."""
    names = [f"{name}.weight" for name, part in module.named_modules() if isinstance(part, nn.PReLU)]
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    for name, node in zip(names, (node for node in graph.node if node.op_type == "PRelu"), strict=True):
        slopes = onnx.TensorProto()
        slopes.CopyFrom(tensors[node.input[1]])
        slopes.name = node.input[1] = name
        graph.initializer.append(slopes)
    used = {name for node in graph.node for name in node.input}
    for tensor in [tensor for tensor in graph.initializer if tensor.name not in used]:
        graph.initializer.remove(tensor)


def _keep_biases(module: nn.Module, graph: onnx.GraphProto) -> None:
    """Give convolutions back the biases that the exporter leaves out for being zero, as in a head that has learned nothing yet."""
    biases = {f"{name}.weight": part.bias for name, part in module.named_modules() if isinstance(part, nn.Conv2d)}
    there = {tensor.name for tensor in graph.initializer}
    for node in graph.node:
        bias = biases.get(node.input[1]) if node.op_type == "Conv" and len(node.input) == 2 else None
        if bias is not None:
            name = node.input[1].removesuffix("weight") + "bias"
            node.input.append(name)
            if name not in there:
                graph.initializer.append(onnx.numpy_helper.from_array(bias.detach().numpy(), name))
                there.add(name)


def _traced(module: nn.Module, state: State | None, divisor: int, metadata: dict[str, Any]) -> onnx.ModelProto:
    chroma = torch.zeros(1, 1, TRACED[0] // 2, TRACED[1] // 2, dtype=torch.uint8)
    luma = torch.zeros(1, 1, *TRACED, dtype=torch.uint8)
    rows, columns = torch.export.Dim("rows", min=1), torch.export.Dim("columns", min=1)
    multiple = metadata["size_multiple"]
    shapes: list[Any] = [{2: multiple // d * rows, 3: multiple // d * columns} for d in (1, 2, 2)]
    cells = {2: multiple // divisor * rows, 3: multiple // divisor * columns}
    parts = [] if state is None else list(State._fields)
    with _quiet_exporter():
        program = torch.onnx.export(
            module.eval(),
            (luma, chroma, chroma.clone(), *(state or ())),  # a tensor given twice would become one input
            dynamo=True,
            opset_version=OPSET,
            input_names=["y", "u", "v", *(f"{p}_in" for p in parts)],
            output_names=["y_up", "u_up", "v_up", *(f"{p}_out" for p in parts), *(["state_sum"] if parts else [])],
            dynamic_shapes={"y": shapes[0], "u": shapes[1], "v": shapes[2], "state": tuple(cells for _ in parts)}
            if parts
            else tuple(shapes),
            optimize=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    graph = model.graph
    _name_slopes(module, graph)
    _keep_biases(module, graph)
    for traced in (*graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del traced.metadata_props[:]  # where in whose files it was traced: half a megabyte that says nothing to a client
    for key, value in {"gamesr_format": FORMAT_VERSION, **metadata}.items():
        if value is None:
            continue
        text = value if isinstance(value, str) else json.dumps(value)
        model.metadata_props.append(onnx.StringStringEntryProto(key=key, value=text))
    onnx.checker.check_model(model, full_check=True)
    return model
