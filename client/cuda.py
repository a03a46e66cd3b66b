"""ONNX Runtime on NVIDIA's GPUs: the libraries that it needs, what it multiplies in, and why it does not start."""

from __future__ import annotations

import contextlib
import ctypes
import io
import re
import sys

import onnxruntime as ort

from client.errors import ProviderError

EXECUTION_PROVIDER = "CUDAExecutionProvider"
TF32 = "cuda-tf32"
# Providers, by whether convolutions round their factors to TF32 (11 bits, as float16 has) for tensor cores. The runtime does unless told.
CUDA = {"cuda": "0", TF32: "1"}


def cuda_session(content: bytes, options: ort.SessionOptions, provider: str) -> ort.InferenceSession:
    """A session for a readable model's bytes on one of CUDA; raises ProviderError where the GPU, its driver or CUDA lets it down."""
    with contextlib.redirect_stdout(io.StringIO()):  # where it tells what it did not find
        ort.preload_dlls()  # the wheels of the extra keep CUDA and cuDNN where no loader looks
    ort.set_default_logger_severity(4)  # what fails is one sentence of ours, not the runtime's log
    try:
        session = ort.InferenceSession(content, options, providers=[(EXECUTION_PROVIDER, {"use_tf32": CUDA[provider]})], enable_fallback=0)
    except Exception as error:  # the runtime's exceptions have no common base
        raise ProviderError(f"ONNX Runtime could not start its cuda provider ({_reason(error)}): use --provider cpu") from error
    if EXECUTION_PROVIDER not in session.get_providers():
        raise ProviderError(f"ONNX Runtime could not start its cuda provider: {_what_is_missing()}, or use --provider cpu")
    return session


def _what_is_missing() -> str:
    """What a user can do about it: the driver, which no wheel brings, or the libraries, which the extra does."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return "there is no NVIDIA driver here, so install one"
    return "see that the driver is new enough for its CUDA, and that '.[cuda]' was installed with what it depends on"


def _reason(error: Exception) -> str:
    """What CUDA said, out of all that the runtime says of the place where it did."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    said = re.search(r"CUDA failure \d+: ([^;]{1,200}?) *;", line)
    return said[1] if said else line
