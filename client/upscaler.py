"""One frame and the state in, one upscaled frame and the next state out: an artifact run by ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from client.artifact import ModelSpec
from client.cores import physical_cores
from client.errors import InputError, ModelError, ProviderError
from client.frames import Frame, Plane, plane_shapes
from client.runtime import Binding, Runtime, load_runtime

MAX_OUTPUT_PIXELS = 64 * 2**20
MAX_THREADS = 1024


class State:
    """What the network remembers of one stream, with the buffers that its next frame is computed in.

    Made by `OnnxUpscaler.initial_state` for frames of `height` x `width`. `OnnxUpscaler.step` consumes it and returns the
    next one in its place; the two alternate between two sets of tensors, so nothing is allocated per frame for the state.
    `restarted` says that the step which returned it found its state lost and began again from zeros. Of a frame everything
    is computed: `computed_share` is 1.
    """

    __slots__ = ("_buffers", "_consumed", "_current", "height", "restarted", "width")
    computed_share = 1.0

    def __init__(self, buffers: _StreamBuffers, current: int, restarted: bool) -> None:
        self.height, self.width = buffers.height, buffers.width
        self.restarted = restarted
        self._buffers = buffers
        self._current = current
        self._consumed = False

    def copy(self) -> State:
        """A state of its own with the same content, that outlives the step which consumes this one."""
        self._check()
        return State(self._buffers.copy(self._current), 0, self.restarted)

    def tensors(self) -> list[np.ndarray]:
        """The state tensors (1, channels, H/divisor, W/divisor) in the processor's memory, of which H and W are the padded size.

        They are in the order of `ModelSpec.state`. What is written into them is what the next step begins with; steps to come
        write into them as well. Raises ProviderError where they lie on a device.
        """
        self._check()
        return self._buffers.tensors(self._current)

    def arrays(self) -> list[np.ndarray]:
        """What the tensors hold, wherever they lie, in the order and the shapes of `tensors`: to be read, and before the next step."""
        self._check()
        return self._buffers.arrays(self._current)

    def _take(self) -> tuple[_StreamBuffers, int]:
        self._check()
        self._consumed = True
        return self._buffers, self._current

    def _check(self) -> None:
        if self._consumed:
            raise ValueError("this state was consumed by an earlier step: pass on the one it returned, or keep a copy()")


class OnnxUpscaler:
    """A self-describing artifact ready to run; every network and every baseline looks the same from here.

    `provider` is one of client.runtime.PROVIDERS; `threads` is the number of threads of one operator, by default the physical cores
    available to the process. One upscaler serves any number of streams, one step at a time. Raises ModelError for a file
    that is not an artifact of ours, ProviderError for a provider that is not installed or does not start, and ValueError for threads
    that are no number from 1 to 1024.
    """

    def __init__(self, model: Path, *, provider: str = "cpu", threads: int | None = None) -> None:
        if threads is not None and not (isinstance(threads, int) and 1 <= threads <= MAX_THREADS):
            raise ValueError(f"threads is {threads}, not a whole number from 1 to {MAX_THREADS}")
        self.provider = provider
        self.threads = threads or physical_cores()
        self._runtime, self.spec = load_runtime(model, provider, self.threads)

    def initial_state(self, height: int, width: int) -> State:
        """An empty memory for frames of `height` x `width` pixels; raises InputError when the result would be too large."""
        scale = self.spec.scale
        if min(height, width) < 1:
            raise ValueError(f"a frame of {width}x{height} has no pixels")
        if height * width * scale * scale > MAX_OUTPUT_PIXELS:
            raise InputError(
                f"{width}x{height} upscaled by {scale} is more than {MAX_OUTPUT_PIXELS // 2**20} megapixels: use a smaller video or scale"
            )
        return State(_StreamBuffers(self._runtime, self.spec, height, width), 0, restarted=False)

    def begin_again(self, state: State) -> State:
        """An empty memory in the buffers of `state`, which is consumed: a stream that begins anew while it is played needs no new ones.

        Raises ValueError for a consumed state or another upscaler's.
        """
        buffers, current = self._taken(state)
        buffers.clear(current)
        return State(buffers, current, restarted=False)

    def state_of(self, height: int, width: int, tensors: Sequence[np.ndarray]) -> State:
        """The memory that `State.tensors` gave out, or one like it, for frames of `height` x `width` pixels.

        The values are taken over in the dtype that the model has them in. Raises ValueError where there are more or fewer tensors, or of
        other shapes.
        """
        state = self.initial_state(height, width)
        state._buffers.fill(state._current, tensors)
        return state

    def step(self, frame: Frame, state: State) -> tuple[Frame, State]:
        """Upscale one frame.

        `frame` has the size that `state` was made for. The picture returned is `scale` times as high and as wide (an odd
        size stays odd), carries the frame's pts, time_base, colour and damaged, and is valid for as long as it is held:
        its planes are new arrays. `state` is consumed. A state that came out not finite is lost: the frame is computed
        again from zeros and the state returned says `restarted`.

        Raises ValueError for a consumed state, one of another size or of another upscaler, ModelError when the model fails on the frame.
        """
        if (frame.height, frame.width) != (state.height, state.width):
            raise ValueError(f"a {frame.width}x{frame.height} frame for a state of {state.width}x{state.height}")
        buffers, current = self._taken(state)
        buffers.load(frame)
        planes, state_sum = buffers.run(current)
        restarted = not np.isfinite(state_sum)
        if restarted:
            buffers.clear(current)
            planes, state_sum = buffers.run(current)
            if not np.isfinite(state_sum):
                raise ModelError(f"model {self.spec.name} loses its state even when it starts from zeros: the file is damaged")
        picture = replace(frame, y=planes[0], u=planes[1], v=planes[2])
        return picture, State(buffers, 1 - current, restarted)

    def _taken(self, state: State) -> tuple[_StreamBuffers, int]:
        """What `state` holds, which is consumed; its buffers are bound to the model that made it."""
        if state._buffers.runtime is not self._runtime:
            raise ValueError(f"this state was made by another upscaler than this one of {self.spec.name}")
        return state._take()

    def warm_up(self, height: int, width: int) -> None:
        """Run a few grey frames, so that the first real one does not pay for allocation and first use."""
        grey = [np.full(shape, 128, np.uint8) for shape in plane_shapes(height, width)]
        state = self.initial_state(height, width)
        for _ in range(3):
            _, state = self.step(Frame(grey[0], grey[1], grey[2]), state)


class _StreamBuffers:
    """The tensors of one stream: input planes, two sets of state tensors, and the two bindings that alternate between them."""

    def __init__(self, runtime: Runtime, spec: ModelSpec, height: int, width: int) -> None:
        self.height, self.width = height, width
        self.runtime, self._spec = runtime, spec
        self._padded = spec.padded(height), spec.padded(width)
        self._inputs = [np.empty((1, 1, *shape), np.uint8) for shape in plane_shapes(*self._padded)]
        self._input_tensors = [runtime.tensor(array) for array in self._inputs]
        self._arrays = [self._zeros() for _ in range(2)]
        self._states = [[runtime.tensor(array, on_device=True) for array in arrays] for arrays in self._arrays]
        self._state_sum = np.zeros((), np.float32)
        self._bindings = [self._bind(current) for current in range(2)]

    def load(self, frame: Frame) -> None:
        """Copy the planes in, replicating the last row and column where the size does not fit the model."""
        for buffer, plane in zip(self._inputs, (frame.y, frame.u, frame.v), strict=True):
            copy_padded(plane, buffer[0, 0])

    def run(self, current: int) -> tuple[list[Plane], float]:
        """Compute from state set `current` into the other; the planes are new arrays, cropped to the scaled size."""
        scale = self._spec.scale
        outputs = [np.empty((1, 1, *shape), np.uint8) for shape in plane_shapes(self._padded[0] * scale, self._padded[1] * scale)]
        binding = self._bindings[current]
        for name, tensor in zip(("y", "u", "v"), self._input_tensors, strict=True):
            binding.bind_input(name, tensor)  # for every frame: where the device has its own memory, binding is what copies
        for name, array in zip(("y_up", "u_up", "v_up"), outputs, strict=True):
            binding.bind_output(name, self.runtime.tensor(array))
        try:
            binding.run()
        except Exception as error:  # the runtime's exceptions have no common base
            reason = str(error).strip().splitlines()[0]
            raise ModelError(f"model {self._spec.name} failed on a {self.width}x{self.height} frame: {reason}") from error
        shapes = plane_shapes(self.height * scale, self.width * scale)
        return [array[0, 0, :height, :width] for array, (height, width) in zip(outputs, shapes, strict=True)], float(self._state_sum)

    def clear(self, current: int) -> None:
        self.fill(current, self._zeros())

    def fill(self, current: int, arrays: Sequence[np.ndarray]) -> None:
        """Take over values; a runtime would take over the bytes of another dtype, or what lies behind fewer of them."""
        shapes = [own.shape for own in self._arrays[current]]
        if [np.shape(array) for array in arrays] != shapes:
            raise ValueError(f"tensors of {[np.shape(array) for array in arrays]} are no state of {self._spec.name}, which has {shapes}")
        for tensor, array, own in zip(self._states[current], arrays, self._arrays[current], strict=True):
            tensor.update_inplace(np.ascontiguousarray(array, own.dtype))

    def tensors(self, current: int) -> list[np.ndarray]:
        if self._arrays[current] and self.runtime.has_own_memory:
            raise ProviderError(f"the state of {self._spec.name} lies in the memory of a device, where no part of it can be replaced")
        return self._arrays[current]

    def arrays(self, current: int) -> list[np.ndarray]:
        if self.runtime.has_own_memory:
            return [tensor.numpy() for tensor in self._states[current]]  # a copy of what lies there
        return self._arrays[current]  # on the CPU a tensor made from an array is that array, and does not keep it alive

    def copy(self, current: int) -> _StreamBuffers:
        """Buffers of their own, whose state set 0 is this one's set `current`."""
        twin = _StreamBuffers(self.runtime, self._spec, self.height, self.width)
        twin.fill(0, self.arrays(current))
        return twin

    def _zeros(self) -> list[np.ndarray]:
        height, width = self._padded
        return [np.zeros((1, s.channels, height // s.divisor, width // s.divisor), s.dtype) for s in self._spec.state]

    def _bind(self, current: int) -> Binding:
        inputs = {name: array.shape for name, array in zip(("y", "u", "v"), self._inputs, strict=True)}
        states = {state.input: array.shape for state, array in zip(self._spec.state, self._arrays[current], strict=True)}
        binding = self.runtime.binding({**inputs, **states})
        for spec, before, after in zip(self._spec.state, self._states[current], self._states[1 - current], strict=True):
            binding.bind_input(spec.input, before)
            binding.bind_output(spec.output, after)
        if self._spec.state:
            binding.bind_output("state_sum", self.runtime.tensor(self._state_sum))
        return binding


def copy_padded(plane: Plane, target: Plane) -> None:
    """Copy a plane into the upper left corner of one that is as large or larger, its last row and column replicated over the rest."""
    height, width = plane.shape
    target[:height, :width] = plane
    target[:height, width:] = target[:height, width - 1 : width]
    target[height:] = target[height - 1]
