"""Parity: an artifact in ONNX Runtime against the same weights in torch float64, over many recurrent steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import numpy_helper

from client.artifact import load_session
from client.errors import InputError, ModelError
from client.frames import Frame
from model.export import to_codes
from model.network import GameSR, NetworkConfig, Planes, State, deployed


@dataclass(frozen=True)
class StepError:
    """What one step's result differs by: pictures in code values (planes Y, U, V together), states in their own units."""

    step: int
    max_code_error: int
    differing_pixels: float
    max_state_error: float
    rms_state_error: float


def network_of_artifact(artifact: Path) -> GameSR:
    """The fused network in float64 with an artifact's weights; raises ModelError when it does not say what network it is."""
    _, spec = load_session(artifact, "cpu", 1)
    if "network" not in spec.card:
        raise ModelError(f"{artifact} is no network: only a trained artifact has weights to verify")
    network = deployed(GameSR(NetworkConfig(**spec.card["network"])))
    weights = {
        t.name.removeprefix("network."): torch.from_numpy(numpy_helper.to_array(t).copy()) for t in onnx.load(artifact).graph.initializer
    }
    missing = network.state_dict().keys() - weights.keys()
    if missing:
        raise ModelError(f"{artifact} lacks the weights {', '.join(sorted(missing))}")
    network.load_state_dict({name: weights[name] for name in network.state_dict()})
    return network.double().eval()


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of "320x180", both even; raises InputError."""
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()) or int(width) % 2 or int(height) % 2 or not int(width) * int(height):
        raise InputError(f"{text!r} is not a size: write 320x180, both even")
    return int(width), int(height)


def crop(frame: Frame, width: int, height: int) -> Frame:
    """The middle of a frame, cut at even pixels, or all of it where it is smaller; width and height are even."""
    top, left = (max(0, (have - want) // 4 * 2) for have, want in ((frame.height, height), (frame.width, width)))
    rows, columns = slice(top // 2, (top + height) // 2), slice(left // 2, (left + width) // 2)
    luma = frame.y[top : top + height, left : left + width]
    return replace(frame, y=luma, u=frame.u[rows, columns], v=frame.v[rows, columns])


def there_and_back(frames: list[Frame], steps: int) -> Iterator[Frame]:
    """The clip played forwards, backwards and so on for `steps` frames: motion without a cut, for as long as one likes."""
    order = list(range(len(frames))) + list(range(len(frames) - 2, 0, -1))
    for step in range(steps):
        yield frames[order[step % len(order)]]


@torch.no_grad()
def parity(artifact: Path, frames: list[Frame], steps: int, *, threads: int = 1) -> Iterator[StepError]:
    """Run both for `steps` frames, each carrying its own state from zeros, and give the difference after every step.

    The artifact runs in ONNX Runtime on the CPU at its own precision; the reference is float64 throughout and rounds its
    pictures only at the end, as the artifact does.
    """
    session, spec = load_session(artifact, "cpu", threads)
    network = network_of_artifact(artifact)
    height, width = frames[0].height, frames[0].width
    expected = network.initial_state(1, height, width)
    state = {s.input: np.zeros((1, s.channels, height // s.divisor, width // s.divisor), np.float32) for s in spec.state}
    for step, frame in enumerate(there_and_back(frames, steps), 1):
        inputs = {name: np.ascontiguousarray(plane)[None, None] for name, plane in zip("yuv", (frame.y, frame.u, frame.v), strict=True)}
        outputs = dict(zip([o.name for o in session.get_outputs()], _run(session, {**inputs, **state}), strict=True))
        state = {s.input: outputs[s.output] for s in spec.state}
        picture, expected = network.step(Planes(*(torch.from_numpy(p).double() for p in inputs.values())), expected)
        difference = np.concatenate(
            [
                (to_codes(plane).numpy().astype(np.int16) - outputs[name]).ravel()
                for name, plane in zip(("y_up", "u_up", "v_up"), picture, strict=True)
            ]
        )
        drift = _state_difference(expected, list(state.values()))
        yield StepError(
            step,
            int(np.abs(difference).max()),
            float(np.count_nonzero(difference) / difference.size),
            float(np.abs(drift).max()),
            float(np.sqrt(np.square(drift).mean())),
        )


def _run(session: ort.InferenceSession, inputs: dict[str, NDArray[np.generic]]) -> list[NDArray[np.generic]]:
    outputs: list[NDArray[np.generic]] = session.run(None, inputs)
    return outputs


def _state_difference(expected: State | None, found: list[NDArray[np.generic]]) -> NDArray[np.float64]:
    if expected is None:
        return np.zeros(1)
    return np.concatenate([(a.numpy() - b).ravel() for a, b in zip(expected, found, strict=True)])
