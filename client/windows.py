"""Windows of a frame run through a model, each with its part of the state, and put back where they belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from client.cuda import CUDA
from client.errors import ModelError, ProviderError
from client.frames import Frame
from client.runtime import OPENVINO
from client.tiles import Box, Window
from client.upscaler import OnnxUpscaler, State


def can_run_windows(upscaler: OnnxUpscaler) -> bool:
    """Whether the runtime takes windows of any size, and the state, where there is one, is in the processor's memory."""
    return upscaler.provider not in OPENVINO and not (upscaler.provider in CUDA and upscaler.spec.state)


def windowed_reach(upscaler: OnnxUpscaler) -> int:
    """How far around a window the model looks; raises ModelError or ProviderError where it cannot be run in windows."""
    if upscaler.provider in OPENVINO:
        raise ProviderError("OpenVINO compiles a model for every size of a window: compute a part of a frame with --provider cpu")
    if upscaler.spec.reach is None:
        raise ModelError(f"model {upscaler.spec.name} does not say how far it reaches: export it again to compute a part of a frame")
    return upscaler.spec.reach


def run_windows(upscaler: OnnxUpscaler, frame: Frame, windows: Sequence[Window], state: State, picture: Frame) -> bool:
    """Compute `windows` of `frame`, each of them from its part of `state`, into the planes of `picture` and into `state`.

    What lies in a window's inner area is, to the bit, what a step with the whole frame and that state gives there. False where a window
    lost its state: neither `picture` nor `state` is then to be used. Raises what `OnnxUpscaler.step` raises.
    """
    parts = []
    for window in windows:
        part, after = upscaler.step(_cut(frame, window.outer), _cut_state(upscaler, frame, state, window.outer))
        if after.restarted:
            return False
        _paste(part, window, picture, upscaler.spec.scale)
        parts.append(after)
    for window, after in zip(windows, parts, strict=True):  # only now: each window begins with the state before this frame
        for spec, target, source in zip(upscaler.spec.state, state.tensors(), after.tensors(), strict=True):
            target[(..., *window.inner.slices(divide=spec.divisor))] = source[(..., *window.inside().slices(divide=spec.divisor))]
    return True


def _cut(frame: Frame, box: Box) -> Frame:
    """An area of a frame; what of it lies beyond the frame is padding, which the step adds again."""
    luma, chroma = box.slices(), box.slices(divide=2)
    return replace(frame, y=frame.y[luma], u=frame.u[chroma], v=frame.v[chroma])


def _cut_state(upscaler: OnnxUpscaler, frame: Frame, state: State, outer: Box) -> State:
    part = upscaler.initial_state(min(outer.bottom, frame.height) - outer.top, min(outer.right, frame.width) - outer.left)
    for spec, target, source in zip(upscaler.spec.state, part.tensors(), state.tensors(), strict=True):
        target[:] = source[(..., *outer.slices(divide=spec.divisor))]
    return part


def _paste(part: Frame, window: Window, picture: Frame, scale: int) -> None:
    for target, source, divide in ((picture.y, part.y, 1), (picture.u, part.u, 2), (picture.v, part.v, 2)):
        place = target[window.inner.slices(scale, divide)]  # ends with the picture, where the frame is padded
        place[:] = source[window.inside().slices(scale, divide)][: place.shape[0], : place.shape[1]]
