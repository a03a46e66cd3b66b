"""What computes an artifact's graph: ONNX Runtime on a processor or a GPU, or OpenVINO, which has bfloat16 on processors."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from client.artifact import ORT_PROVIDERS, ModelSpec, load_session, read_artifact
from client.cuda import CUDA
from client.errors import ModelError, ProviderError, how_to_install
from client.int8_weights import MOST, sums_fit
from client.norms import norms_in_place
from client.precise import states_in_float32

Array = NDArray[np.generic]
BFLOAT16 = "openvino-bfloat16"
FLOAT16 = "openvino-float16"
OPENVINO = {"openvino": "f32", BFLOAT16: "bf16", FLOAT16: "f16"}  # providers, by what OpenVINO calls what they compute in
CAPABILITIES = {"f32": "FP32", "bf16": "BF16", "f16": "FP16"}  # what it says of a processor that computes in it
PROVIDERS = (*ORT_PROVIDERS, *OPENVINO)
MAX_COMPILED_SIZES = 4


class Tensor(Protocol):
    """Memory that a graph reads or writes."""

    def numpy(self) -> Array: ...

    def update_inplace(self, array: Array) -> None: ...


class Binding(Protocol):
    """The tensors of one run, by the names of the graph's inputs and outputs; they may be replaced between runs."""

    def bind_input(self, name: str, tensor: Any) -> None: ...

    def bind_output(self, name: str, tensor: Any) -> None: ...

    def run(self) -> None: ...


class Runtime(Protocol):
    """A graph ready to run. `tensor` gives one over `array`, without a copy, or in the device's own memory if it has one.

    `binding` is for inputs of these shapes.
    """

    has_own_memory: bool

    def tensor(self, array: Array, *, on_device: bool = False) -> Tensor: ...

    def binding(self, shapes: Mapping[str, tuple[int, ...]]) -> Binding: ...


def load_runtime(model: Path, provider: str, threads: int) -> tuple[Runtime, ModelSpec]:
    """An artifact on one of PROVIDERS, and what it says of itself; raises ModelError or ProviderError."""
    if provider not in PROVIDERS:
        raise ProviderError(f"there is no provider {provider!r}: choose one of {', '.join(PROVIDERS)}")
    if provider not in OPENVINO:
        session, spec = load_session(model, provider, threads)
        return OrtRuntime(session, "cuda" if provider in CUDA else "cpu"), spec
    openvino()  # whether it is there is said before anything is read
    _, spec = load_session(model, "cpu", 1)
    return OpenVinoRuntime(read_artifact(model), threads=threads, provider=provider), spec


class OrtRuntime:
    """A session of ONNX Runtime."""

    def __init__(self, session: ort.InferenceSession, device: str) -> None:
        self._session, self._device = session, device
        self.has_own_memory = device != "cpu"

    def tensor(self, array: Array, *, on_device: bool = False) -> Tensor:
        value: Tensor = ort.OrtValue.ortvalue_from_numpy(array, self._device if on_device else "cpu", 0)
        return value

    def binding(self, shapes: Mapping[str, tuple[int, ...]]) -> Binding:
        return _OrtBinding(self._session)


class _OrtBinding:
    def __init__(self, session: ort.InferenceSession) -> None:
        self._session, self._binding = session, session.io_binding()

    def bind_input(self, name: str, tensor: Any) -> None:
        self._binding.bind_ortvalue_input(name, tensor)

    def bind_output(self, name: str, tensor: Any) -> None:
        self._binding.bind_ortvalue_output(name, tensor)

    def run(self) -> None:
        self._session.run_with_iobinding(self._binding)


def is_installed(provider: str) -> bool:
    """Whether one of PROVIDERS is there to be tried; whether it starts on this machine shows when it does."""
    if provider in OPENVINO:
        return importlib.util.find_spec("openvino") is not None
    return ORT_PROVIDERS[provider] in ort.get_available_providers()


def openvino() -> ModuleType:
    """The module, which is an extra; raises ProviderError where it is not installed."""
    try:
        return importlib.import_module("openvino")
    except ImportError as error:
        raise ProviderError(f"OpenVINO is not installed: {how_to_install('cpu', 'openvino')}") from error


@functools.cache
def _core() -> Any:
    """One for the process, until its end.

    Each one gives its thread a stack for signals, and puts back the stack before it when it goes. Of two that go in the order in which
    they came the second puts back one that is not there any more, and the next Ctrl-C ends the program where it stands.
    """
    return openvino().Core()


def computes_in(provider: str) -> bool:
    """Whether the processor has the precision of one of OPENVINO; raises ProviderError where that is not installed."""
    return CAPABILITIES[OPENVINO[provider]] in _core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


class OpenVinoRuntime:
    """A graph compiled by OpenVINO for every size that it is used at, since fixed sizes save a third of a small network's time.

    `provider` is one of OPENVINO: the inner layers compute in its precision; inputs, outputs and the state stay as they are. With
    `counting` a request knows what each operation took. Raises ProviderError where the processor does not have the precision.
    """

    has_own_memory = False

    def __init__(self, content: bytes, *, threads: int, provider: str, counting: bool = False) -> None:
        self._ov = openvino()
        self._core = _core()
        self._precision = OPENVINO[provider]
        if not computes_in(provider):
            raise ProviderError(f"this processor does not compute in {provider.removeprefix('openvino-')}: use --provider openvino")
        self._content = content
        self._options = {
            "INFERENCE_PRECISION_HINT": self._precision,
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            "PERF_COUNT": counting,
            "ENABLE_CPU_PINNING": False,  # a thread bound to a core waits for whoever computes there, and all others for it
        }
        self._compiled: dict[tuple[tuple[str, tuple[int, ...]], ...], Any] = {}

    def tensor(self, array: Array, *, on_device: bool = False) -> Tensor:
        return _OpenVinoTensor(self._ov, array)

    def binding(self, shapes: Mapping[str, tuple[int, ...]]) -> Binding:
        return _OpenVinoBinding(self.request(shapes))

    def request(self, shapes: Mapping[str, tuple[int, ...]]) -> Any:
        """OpenVINO's own request for inputs of these shapes; the same one for the same shapes. Raises ModelError."""
        key = tuple(sorted(shapes.items()))
        if key not in self._compiled:
            if len(self._compiled) == MAX_COMPILED_SIZES:
                self._compiled.pop(next(iter(self._compiled)))  # streams of that size keep what they have
            try:
                model = self._core.read_model(self._content)
                if not sums_fit(model):
                    raise ValueError(f"its 8-bit weights go beyond {MOST}, whose sums some processors cut off: quantize it again")
                if self._precision != "f16":  # where it has not been measured
                    norms_in_place(self._ov, model)
                model.reshape({name: list(shape) for name, shape in shapes.items()})
                if self._precision == "bf16":
                    model = states_in_float32(self._ov, self._core, model)
                self._compiled[key] = self._core.compile_model(model, "CPU", self._options).create_infer_request()
            except Exception as error:  # the runtime's exceptions have no common base
                reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
                raise ModelError(f"OpenVINO cannot compile the model: {reason}") from error
        return self._compiled[key]


class _OpenVinoTensor:
    def __init__(self, ov: ModuleType, array: Array) -> None:
        self._array = array  # OpenVINO does not keep it alive
        self.tensor = ov.Tensor(array, shared_memory=True)

    def numpy(self) -> Array:
        return self._array

    def update_inplace(self, array: Array) -> None:
        self._array[...] = array


class _OpenVinoBinding:
    """The request is shared by all bindings of a size, which run one at a time: each sets its tensors anew."""

    def __init__(self, request: Any) -> None:
        self._request = request
        self._tensors: dict[str, _OpenVinoTensor] = {}

    def bind_input(self, name: str, tensor: _OpenVinoTensor) -> None:
        self._tensors[name] = tensor

    def bind_output(self, name: str, tensor: _OpenVinoTensor) -> None:
        self._tensors[name] = tensor

    def run(self) -> None:
        for name, tensor in self._tensors.items():
            self._request.set_tensor(name, tensor.tensor)
        self._request.infer()
