"""Parity: an artifact in ONNX Runtime against the same weights in torch float64, over many recurrent steps."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper

from client.artifact import load_session
from client.errors import InputError, ModelError
from client.frames import Frame, Plane
from client.upscaler import OnnxUpscaler, State
from model.catalogue import described_network
from model.export import to_codes
from model.hard_cases import there_and_back
from model.planes import Network, Planes


@dataclass(frozen=True)
class StepError:
    """What one step's result differs by: pictures in code values (planes Y, U, V together), states in their own units."""

    step: int
    max_code_error: int
    differing_pixels: float
    max_state_error: float
    rms_state_error: float


def network_of_artifact(artifact: Path) -> Network:
    """The fused network in float64 with an artifact's weights; raises ModelError when it does not say what network it is."""
    _, spec = load_session(artifact, "cpu", 1)
    if "network" not in spec.card:
        raise ModelError(f"{artifact} is no network: only a trained artifact has weights to verify")
    network = described_network(spec.card["network"]).deployed()
    weights = {
        t.name.removeprefix("network."): torch.from_numpy(numpy_helper.to_array(t).copy()) for t in onnx.load(artifact).graph.initializer
    }
    shapes = {name: weight.shape for name, weight in network.state_dict().items()}
    missing = shapes.keys() - weights.keys()
    if missing:
        raise ModelError(f"{artifact} lacks the weights {', '.join(sorted(missing))}")
    network.load_state_dict({name: weights[name].reshape(shape) for name, shape in shapes.items()})  # slopes of PReLU lie over channels
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


class Reference:
    """A network in float64 on one stream, fed as the client feeds an artifact: padded to the size multiple, rounded, cropped."""

    def __init__(self, network: Network, height: int, width: int) -> None:
        multiple = network.size_multiple
        self._network, self._multiple = network, multiple
        self._state = network.initial_state(1, -(-height // multiple) * multiple, -(-width // multiple) * multiple)

    @torch.no_grad()
    def step(self, frame: Frame) -> list[Plane]:
        """The upscaled planes of the next frame, uint8; raises ModelError when they are not finite."""
        multiple, scale = self._multiple, self._network.scale
        height, width = -(-frame.height // multiple) * multiple, -(-frame.width // multiple) * multiple
        sizes = ((height, width), (height // 2, width // 2), (height // 2, width // 2))
        planes = [
            np.pad(plane, ((0, rows - plane.shape[0]), (0, columns - plane.shape[1])), mode="edge")
            for plane, (rows, columns) in zip((frame.y, frame.u, frame.v), sizes, strict=True)
        ]
        picture, self._state = self._network.step(Planes(*(torch.from_numpy(p)[None, None].double() for p in planes)), self._state)
        if not all(bool(plane.isfinite().all()) for plane in picture):
            raise ModelError("its pictures are not finite even in float64: the weights are damaged")
        high, wide = scale * frame.height, scale * frame.width
        shapes = ((high, wide), (-(-high // 2), -(-wide // 2)), (-(-high // 2), -(-wide // 2)))
        return [to_codes(plane)[0, 0, :rows, :columns].numpy() for plane, (rows, columns) in zip(picture, shapes, strict=True)]

    def state(self) -> list[NDArray[np.float64]]:
        return [] if self._state is None else [part.numpy() for part in self._state]


@dataclass(frozen=True)
class Played:
    """One frame through an artifact: the picture, how long it took, whether the state was lost, what is remembered now.

    `error` is against the float64 reference, None where the artifact has none.
    """

    picture: Frame
    duration_ns: int
    restarted: bool
    state: list[NDArray[np.floating]]
    error: StepError | None


def play(upscaler: OnnxUpscaler, network: Network | None, frames: Iterable[Frame]) -> Iterator[Played]:
    """Frames of one size through an artifact, as the client runs it, and through its reference, each with its own state."""
    state: State | None = None
    reference: Reference | None = None
    for step, frame in enumerate(frames, 1):
        if state is None:
            state = upscaler.initial_state(frame.height, frame.width)
            reference = Reference(network, frame.height, frame.width) if network else None
        begin_ns = time.perf_counter_ns()
        picture, state = upscaler.step(frame, state)
        duration_ns = time.perf_counter_ns() - begin_ns
        tensors = state.tensors()
        error = _error(step, picture, tensors, reference.step(frame), reference.state()) if reference else None
        yield Played(picture, duration_ns, state.restarted, tensors, error)


def parity(artifact: Path, frames: list[Frame], steps: int, *, threads: int = 1) -> Iterator[StepError]:
    """Run both for `steps` frames, each carrying its own state from zeros, and give the difference after every step.

    The artifact runs in ONNX Runtime on the CPU at its own precision; the reference is float64 throughout and rounds its
    pictures only at the end, as the artifact does.
    """
    network = network_of_artifact(artifact)
    for played in play(OnnxUpscaler(artifact, threads=threads), network, there_and_back(frames, steps)):
        assert played.error is not None
        yield played.error


def _error(
    step: int, picture: Frame, state: list[NDArray[np.floating]], planes: list[Plane], expected: list[NDArray[np.float64]]
) -> StepError:
    difference = np.concatenate(
        [(wanted.astype(np.int16) - found).ravel() for wanted, found in zip(planes, (picture.y, picture.u, picture.v), strict=True)]
    )
    drift = np.concatenate([(a - b).ravel() for a, b in zip(expected, state, strict=True)] or [np.zeros(1)])
    return StepError(
        step,
        int(np.abs(difference).max()),
        float(np.count_nonzero(difference) / difference.size),
        float(np.abs(drift).max()),
        float(np.sqrt(np.square(drift).mean())),
    )
