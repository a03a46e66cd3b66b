"""Parity: an artifact in ONNX Runtime against the same weights in torch float64, over many recurrent steps."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from client.errors import InputError, ModelError
from client.frames import Frame, Plane
from client.quality import psnr_db, squared_error
from client.upscaler import OnnxUpscaler, State
from model.artifact_weights import network_of_artifact
from model.export import to_codes
from model.hard_cases import there_and_back
from model.planes import Network, Planes


@dataclass(frozen=True)
class StepError:
    """What one step's result differs by: pictures in code values (planes Y, U, V together), states in their own units.

    `provider` is what ran the artifact. `p999_code_error` is the 99.9th percentile of all samples' errors, `psnr_y_db` that of
    the luma against the reference's rounded picture, None where the two are equal. `differing_pixels` is a share of the `samples`
    of all planes. `largest_state` is the largest magnitude in the artifact's state, which the bound of its error is relative to.
    """

    provider: str
    step: int
    max_code_error: int
    p999_code_error: int
    differing_pixels: float
    psnr_y_db: float | None
    max_state_error: float
    rms_state_error: float
    largest_state: float
    samples: int


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of "320x180", both even; raises InputError."""
    sides = re.fullmatch("([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if sides is None or int(sides[1]) % 2 or int(sides[2]) % 2:
        raise InputError(f"{text!r} is not a size: write 320x180, both even")
    return int(sides[1]), int(sides[2])


def crop(frame: Frame, width: int, height: int) -> Frame:
    """The middle of a frame, cut at even pixels, or all of it where it is smaller; width and height are even.

    Its planes are copies: a view would keep the whole picture in memory for as long as the crop.
    """
    top, left = (max(0, (have - want) // 4 * 2) for have, want in ((frame.height, height), (frame.width, width)))
    rows, columns = slice(top // 2, (top + height) // 2), slice(left // 2, (left + width) // 2)
    luma = frame.y[top : top + height, left : left + width]
    return replace(frame, y=luma.copy(), u=frame.u[rows, columns].copy(), v=frame.v[rows, columns].copy())


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
    return (played for (played,) in play_together([upscaler], network, frames))


def play_together(upscalers: Sequence[OnnxUpscaler], network: Network | None, frames: Iterable[Frame]) -> Iterator[list[Played]]:
    """The same through several upscalers and one reference, in their order, frame by frame; every one has its own state."""
    states: list[State] = []
    reference: Reference | None = None
    for step, frame in enumerate(frames, 1):
        if not states:
            states = [upscaler.initial_state(frame.height, frame.width) for upscaler in upscalers]
            reference = Reference(network, frame.height, frame.width) if network else None
        expected = None if reference is None else (reference.step(frame), reference.state())
        together = []
        for index, upscaler in enumerate(upscalers):
            begin_ns = time.perf_counter_ns()
            picture, state = upscaler.step(frame, states[index])
            duration_ns = time.perf_counter_ns() - begin_ns
            states[index] = state
            arrays = state.arrays()
            error = None if expected is None else step_error(upscaler.provider, step, picture, arrays, *expected)
            together.append(Played(picture, duration_ns, state.restarted, arrays, error))
        yield together


def parity(
    artifact: Path,
    frames: list[Frame],
    steps: int,
    *,
    providers: Sequence[str] = ("cpu",),
    weights: Path | None = None,
    threads: int = 1,
) -> Iterator[StepError]:
    """Run an artifact for `steps` frames, its state carried from zeros, and give the difference from its reference after every step.

    Each of `providers` runs it at its own precision, with its own state, and gives an error a step, in their order; the
    reference is float64 throughout and rounds its pictures only at the end, as the artifact does. Of an int8 artifact it has
    the weights of the float32 one, `weights`.
    """
    upscalers = [OnnxUpscaler(artifact, provider=provider, threads=threads) for provider in providers]
    for together in play_together(upscalers, network_of_artifact(artifact, weights), there_and_back(frames, steps)):
        for played in together:
            assert played.error is not None
            yield played.error


PARITY_HEADER = "| frame | provider | max | 99.9% | differing | PSNR-Y | state | RMS |\n|---|---|---|---|---|---|---|---|"


def parity_row(frame: str, errors: Sequence[StepError]) -> str:
    """A line of Markdown under `PARITY_HEADER`: the worst of the errors, all of one provider."""
    found = [error.psnr_y_db for error in errors if error.psnr_y_db is not None]
    cells = (
        frame,
        errors[0].provider,
        str(max(error.max_code_error for error in errors)),
        str(max(error.p999_code_error for error in errors)),
        f"{max(error.differing_pixels for error in errors):.1e}",
        f"{min(found):.1f}" if found else "equal",
        f"{np.max([error.max_state_error for error in errors]):.1e}",
        f"{np.max([error.rms_state_error for error in errors]):.1e}",
    )
    return f"| {' | '.join(cells)} |"


def step_error(
    provider: str,
    step: int,
    picture: Frame,
    state: list[NDArray[np.floating]],
    planes: list[Plane],
    expected: list[NDArray[np.float64]],
) -> StepError:
    """How far a picture and a state are from the planes and the state of the reference."""
    pairs = list(zip(planes, (picture.y, picture.u, picture.v), strict=True))
    distances = np.concatenate([np.abs(wanted.astype(np.int16) - found).ravel() for wanted, found in pairs])
    upto = np.bincount(distances).cumsum()  # samples whose error is 0, 0 or 1, and so on
    squared = squared_error(*pairs[0])
    drift = np.concatenate([(a - b).ravel() for a, b in zip(expected, state, strict=True)] or [np.zeros(1)])
    return StepError(
        provider,
        step,
        len(upto) - 1,
        int(np.searchsorted(upto, 0.999 * distances.size)),
        float(1 - upto[0] / distances.size),
        psnr_db(squared / picture.y.size) if squared else None,
        float(np.abs(drift).max()),
        float(np.sqrt(np.square(drift).mean())),
        float(np.max([np.abs(part).max() for part in state], initial=0.0)),
        distances.size,
    )
