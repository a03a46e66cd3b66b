"""What there is to say where a GPU does not start; that one does is for a machine that has one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnxruntime as ort
import pytest

from client import cuda
from client.cuda import CUDA
from client.errors import ModelError, ProviderError
from client.upscaler import OnnxUpscaler

ModelFile = Callable[..., Path]
OF_A_GPU = ["CUDAExecutionProvider", "CPUExecutionProvider"]


@pytest.fixture
def runtime_for_a_gpu(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """ONNX Runtime as its wheel for a GPU is: it has the provider, and what starts it fails as `fails` says, or passes it over unsaid."""
    told: dict[str, Any] = {"fails": None, "providers": []}
    session = ort.InferenceSession

    def start(content: bytes, options: ort.SessionOptions, providers: list[Any], **others: Any) -> ort.InferenceSession:
        if providers == ["CPUExecutionProvider"]:
            return session(content, options, providers=providers)
        told["providers"].append(providers)
        assert others == {"enable_fallback": 0}  # which would print, and go on without the GPU
        if told["fails"]:
            raise RuntimeError(told["fails"])
        return session(content, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr(ort, "get_available_providers", lambda: OF_A_GPU)
    monkeypatch.setattr(ort, "preload_dlls", lambda: print("Failed to load libcudnn.so.9"), raising=False)
    monkeypatch.setattr(ort, "InferenceSession", start)
    return told


@pytest.mark.parametrize("provider", CUDA)
def test_what_is_missing_is_said_in_one_sentence(
    provider: str,
    runtime_for_a_gpu: dict[str, Any],
    model_file: ModelFile,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def no_driver(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(cuda.ctypes, "CDLL", no_driver)
    with pytest.raises(ProviderError, match="could not start its cuda provider: there is no NVIDIA driver here, so install one"):
        OnnxUpscaler(model_file(), provider=provider)
    monkeypatch.setattr(cuda.ctypes, "CDLL", lambda name: None)
    with pytest.raises(ProviderError, match="see that the driver is new enough for its CUDA"):
        OnnxUpscaler(model_file(), provider=provider)
    runtime_for_a_gpu["fails"] = (
        "/onnxruntime_src/cuda_call.cc:154 CudaCall(ERRTYPE, const char*) [with ERRTYPE = cudaError; bool THRW = true] "
        "CUDA failure 35: CUDA driver version is insufficient for CUDA runtime version ; GPU=-1 ; hostname=vm ; file=/a/b.cc ; line=355"
    )
    with pytest.raises(ProviderError, match=r"provider \(CUDA driver version is insufficient for CUDA runtime version\): use"):
        OnnxUpscaler(model_file(), provider=provider)
    runtime_for_a_gpu["fails"] = "no kernel image\nis available"
    with pytest.raises(ProviderError, match=r"provider \(no kernel image\): use"):
        OnnxUpscaler(model_file(), provider=provider)
    assert capfd.readouterr() == ("", "")  # a pipe of pictures or of JSON may be there
    assert runtime_for_a_gpu["providers"] == [[("CUDAExecutionProvider", {"use_tf32": "1" if provider == "cuda-tf32" else "0"})]] * 4


def test_a_model_that_cannot_be_read_is_not_blamed_on_the_gpu(runtime_for_a_gpu: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "noise.onnx").write_bytes(b"noise")
    with pytest.raises(ModelError, match="not a readable ONNX model"):
        OnnxUpscaler(tmp_path / "noise.onnx", provider="cuda")
    assert not runtime_for_a_gpu["providers"]
