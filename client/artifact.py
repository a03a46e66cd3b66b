"""What an artifact says of itself, and a session made from one that the client understands."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import onnxruntime as ort

from client.cuda import CUDA, EXECUTION_PROVIDER, cuda_session
from client.errors import ModelError, ProviderError, how_to_install

FORMAT = "1"
MAX_FILE_BYTES = 64 * 2**20
MAX_WORD = 64  # characters of a name
MAX_STATE_CHANNELS = 4096
MAX_REACH = 2048
ORT_PROVIDERS = {"cpu": "CPUExecutionProvider", **dict.fromkeys(CUDA, EXECUTION_PROVIDER)}
_TENSOR_TYPES = {"float32": "tensor(float)", "float16": "tensor(float16)"}


@dataclass(frozen=True)
class StateSpec:
    """A state tensor of shape (1, channels, H / divisor, W / divisor): the graph's input and output of it, and its dtype."""

    input: str
    output: str
    channels: int
    divisor: int
    dtype: str


@dataclass(frozen=True)
class ModelSpec:
    """What the exporter wrote into the artifact; `sha256` is of the file, `card` holds free facts of the training.

    `reach` is how many luma pixels of the input, a multiple of `size_multiple`, the picture and the next state of an area can
    depend on beyond that area; None where the artifact does not say.
    """

    name: str
    scale: int
    size_multiple: int
    precision: str
    state: tuple[StateSpec, ...]
    reach: int | None
    sha256: str
    card: dict[str, Any] = field(hash=False)

    def padded(self, size: int) -> int:
        """The multiple of `size_multiple` that a height or a width is padded to."""
        return -(-size // self.size_multiple) * self.size_multiple


def load_session(model: Path, provider: str, threads: int) -> tuple[ort.InferenceSession, ModelSpec]:
    """Read an artifact, check that it is one the client understands, and make a session of it.

    `provider` is one of ORT_PROVIDERS. The runtime is given bytes, never a path, so a model cannot make it read other files.
    Raises ModelError or ProviderError.
    """
    _check_provider(provider)
    content = read_artifact(model)
    try:  # first where every graph runs: whether a model can be read is not a question of the GPU
        session = ort.InferenceSession(content, session_options(threads), providers=[ORT_PROVIDERS["cpu"]])
    except Exception as error:  # the runtime's exceptions have no common base
        raise ModelError(
            f"{model} is not a readable ONNX model: it is damaged, of another kind, or newer than ONNX Runtime {ort.__version__}"
        ) from error
    try:
        spec = _read_spec(session.get_modelmeta().custom_metadata_map, hashlib.sha256(content).hexdigest())
        _check_tensors(session, spec)
    except _NotUnderstood as reason:
        raise ModelError(f"{model} is not a model that this client understands: {reason}") from None
    if provider in CUDA:
        session = cuda_session(content, session_options(threads), provider)
    return session, spec


class _NotUnderstood(Exception):
    pass


def _check_provider(provider: str) -> None:
    if ORT_PROVIDERS[provider] not in ort.get_available_providers():
        other = "pip uninstall onnxruntime onnxruntime-gpu, then, "  # both install the same module
        raise ProviderError(f"this ONNX Runtime has no cuda provider: {other}{how_to_install('cuda')}")


def read_artifact(model: Path) -> bytes:
    """The bytes of a file that could be an artifact; raises ModelError."""
    model = Path(model)
    try:
        status = model.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe or a device has no size to be held against a limit
            raise ModelError(f"model {model} is not a file")
        if status.st_size > MAX_FILE_BYTES:
            raise ModelError(f"{model} is larger than {MAX_FILE_BYTES // 2**20} MiB: it is not a GameSR model")
        return model.read_bytes()
    except OSError as error:
        raise ModelError(f"model {model} cannot be read: {error.strerror}") from error


def session_options(threads: int) -> ort.SessionOptions:
    """How every session of this product runs: `threads` for one operator, none of them spinning, nothing read beside the model."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # A game, a decoder and an encoder want the cores too: threads that spin while they wait cost a half more under load.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # a refused model is one sentence of ours, not the runtime's log
    # Weights kept outside the file would be looked up in the working directory; there is nothing to be found in here.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    return options


def _read_spec(metadata: dict[str, str], sha256: str) -> ModelSpec:
    version = metadata.get("gamesr_format")
    if version is None:
        raise _NotUnderstood("it does not say gamesr_format, so it was not made by gamesr-export")
    if version != FORMAT:
        raise _NotUnderstood(f"its format is {version!r}, this client reads {FORMAT!r}")
    try:
        spec = ModelSpec(
            name=metadata["name"],
            scale=int(metadata["scale"]),
            size_multiple=int(metadata["size_multiple"]),
            precision=metadata["precision"],
            state=tuple(StateSpec(**entry) for entry in json.loads(metadata["state"])),
            reach=int(metadata["reach"]) if "reach" in metadata else None,
            sha256=sha256,
            card=dict(json.loads(metadata["card"])),
        )
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise _NotUnderstood(f"its metadata is incomplete or wrong ({error})") from error
    if not is_short_word(spec.name) or not is_short_word(spec.precision):
        raise _NotUnderstood("its name or its precision is not a short word")
    if spec.scale not in (2, 3):
        raise _NotUnderstood(f"its scale is {spec.scale}, not 2 or 3")
    if not 2 <= spec.size_multiple <= 64 or spec.size_multiple % 2:
        raise _NotUnderstood(f"its size multiple is {spec.size_multiple}, not an even number up to 64")
    if spec.reach is not None and (not 0 <= spec.reach <= MAX_REACH or spec.reach % spec.size_multiple):
        raise _NotUnderstood(f"its reach is {spec.reach}, not a multiple of {spec.size_multiple} up to {MAX_REACH}")
    for state in spec.state:
        if not all(isinstance(text, str) and is_short_word(text) for text in (state.input, state.output, state.dtype)):
            raise _NotUnderstood("the names of a state or its type are not short words")
        if state.dtype not in _TENSOR_TYPES:
            raise _NotUnderstood(f"its state {state.input} is {state.dtype}")
        if not _is_count(state.channels, MAX_STATE_CHANNELS) or not _is_count(state.divisor, 64) or spec.size_multiple % state.divisor:
            raise _NotUnderstood(f"its state {state.input} has {state.channels} channels at 1/{state.divisor} of the size")
    for fact in ("parameters", "macs_540p"):
        if not isinstance(spec.card.get(fact), int | None):
            raise _NotUnderstood(f"its card's {fact} is not a whole number")
    return spec


def is_short_word(text: str) -> bool:
    """Whether a text may be an artifact's name or precision: it is printed as it is."""
    return text.isascii() and text.isprintable() and 0 < len(text) <= MAX_WORD


def _is_count(value: object, limit: int) -> bool:
    return isinstance(value, int) and 0 < value <= limit


def _check_tensors(session: ort.InferenceSession, spec: ModelSpec) -> None:
    inputs = dict.fromkeys(("y", "u", "v"), ("tensor(uint8)", 4))
    outputs = dict.fromkeys(("y_up", "u_up", "v_up"), ("tensor(uint8)", 4))
    for state in spec.state:
        inputs[state.input] = outputs[state.output] = (_TENSOR_TYPES[state.dtype], 4)
    if spec.state:
        outputs["state_sum"] = ("tensor(float)", 0)
    for kind, wanted, found in (("inputs", inputs, session.get_inputs()), ("outputs", outputs, session.get_outputs())):
        there = {tensor.name: (tensor.type, len(tensor.shape)) for tensor in found}
        if there != wanted:
            raise _NotUnderstood(f"its {kind} are {_listing(there)}, not {_listing(wanted)}")


def _listing(tensors: dict[str, tuple[str, int]]) -> str:
    return ", ".join(
        f"{name if is_short_word(name) else ascii(name[:MAX_WORD])} {kind.removeprefix('tensor')} rank {rank}"
        for name, (kind, rank) in tensors.items()
    )
