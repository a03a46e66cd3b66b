"""Runtimes: OpenVINO against ONNX Runtime on the same artifacts, state carried, at any size and in its precisions."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import openvino
import pytest

from client.errors import ModelError, ProviderError
from client.frames import Frame
from client.runtime import MAX_COMPILED_SIZES, OpenVinoRuntime
from client.upscaler import OnnxUpscaler
from model.export import export_baseline, export_network
from tests.moving import picture
from tests.networks import random_network

HAS = openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("artifacts")
    paths = {name: folder / f"{name}.onnx" for name in ("planes", "balanced", "live", "bicubic")}
    for preset in ("planes", "balanced", "live"):
        export_network(random_network(preset, 2), paths[preset], name=preset, card={})
    export_baseline("bicubic", 2, paths["bicubic"], name="bicubic")
    return paths


def clip_of(frames: int, height: int, width: int) -> list[Frame]:
    return [picture(t, height, width) for t in range(frames)]


def pictures(model: Path, provider: str, frames: list[Frame]) -> list[Frame]:
    upscaler = OnnxUpscaler(model, provider=provider, threads=1)
    state = upscaler.initial_state(frames[0].height, frames[0].width)
    found = []
    for frame in frames:
        upscaled, state = upscaler.step(frame, state)
        found.append(upscaled)
    return found


def difference(found: list[Frame], expected: list[Frame]) -> np.ndarray:
    pairs = [(a, b) for x, y in zip(found, expected, strict=True) for a, b in ((x.y, y.y), (x.u, y.u), (x.v, y.v))]
    return np.concatenate([(a.astype(np.int16) - b).ravel() for a, b in pairs])


def rms(differences: np.ndarray) -> float:
    return float(np.sqrt(np.square(differences.astype(float)).mean()))


@pytest.mark.parametrize("name", ["planes", "balanced", "live", "bicubic"])
@pytest.mark.parametrize("size", [(48, 64), (38, 50)])
def test_openvino_gives_the_same_pictures(artifacts: dict[str, Path], name: str, size: tuple[int, int]) -> None:
    frames = clip_of(12, *size)
    found = difference(pictures(artifacts[name], "openvino", frames), pictures(artifacts[name], "cpu", frames))
    assert np.abs(found).max() <= 1 and np.count_nonzero(found) < 1e-3 * found.size


@pytest.mark.parametrize("name", ["planes", "balanced", "live"])
@pytest.mark.parametrize(("precision", "capability", "largest_rms"), [("bfloat16", "BF16", 1), ("float16", "FP16", 0.3)])
def test_16_bits_are_near_or_refused_where_the_processor_has_none(
    artifacts: dict[str, Path], name: str, precision: str, capability: str, largest_rms: float
) -> None:
    frames = clip_of(12, 48, 64)
    if capability not in HAS:
        with pytest.raises(ProviderError, match=f"does not compute in {precision}"):
            pictures(artifacts[name], f"openvino-{precision}", frames)
        return
    exact = pictures(artifacts[name], "cpu", frames)
    found = difference(pictures(artifacts[name], f"openvino-{precision}", frames), exact)
    assert found.any() and rms(found) < largest_rms
    if precision == "float16" and "BF16" in HAS:
        assert rms(found) < rms(difference(pictures(artifacts[name], "openvino-bfloat16", frames), exact))


def test_more_sizes_than_are_kept_and_streams_that_take_turns(artifacts: dict[str, Path]) -> None:
    upscaler = OnnxUpscaler(artifacts["planes"], provider="openvino", threads=1)
    sizes = [(24 + 4 * n, 32) for n in range(MAX_COMPILED_SIZES + 2)]
    clips = [clip_of(3, *size) for size in sizes]
    states = [upscaler.initial_state(*size) for size in sizes]
    taken: list[list[Frame]] = [[] for _ in sizes]
    for step in range(3):
        for stream, clip in enumerate(clips):
            upscaled, states[stream] = upscaler.step(clip[step], states[stream])
            taken[stream].append(upscaled)
    for clip, found in zip(clips, taken, strict=True):
        assert not difference(found, pictures(artifacts["planes"], "openvino", clip)).any()


def test_a_lost_state_restarts_in_openvino_too(artifacts: dict[str, Path]) -> None:
    upscaler = OnnxUpscaler(artifacts["planes"], provider="openvino", threads=1)
    frame, expected = clip_of(1, 48, 64)[0], pictures(artifacts["planes"], "openvino", clip_of(1, 48, 64))
    state = upscaler.initial_state(48, 64)
    state.tensors()[0][0, 0, 3, 4] = np.nan
    upscaled, state = upscaler.step(frame, state)
    assert state.restarted and not difference([upscaled], expected).any()


def test_without_openvino_it_says_what_to_install(artifacts: dict[str, Path]) -> None:
    with mock.patch.dict("sys.modules", {"openvino": None}), pytest.raises(ProviderError, match=r"'\.\[cpu,openvino\]'"):
        OnnxUpscaler(artifacts["live"], provider="openvino")


def test_what_openvino_cannot_compile_is_one_sentence() -> None:
    with pytest.raises(ModelError, match="OpenVINO cannot compile the model"):
        OpenVinoRuntime(b"text", threads=1, provider="openvino").binding({"y": (1, 1, 4, 4)})


def test_a_signal_ends_nothing_when_sessions_went_in_the_order_in_which_they_came(artifacts: dict[str, Path]) -> None:
    """In a process of its own: what goes wrong there is not an exception."""
    code = f"""
import os, signal
from pathlib import Path
from client.upscaler import OnnxUpscaler
for _ in range(3):  # the one before goes when the next one is there
    upscaler = OnnxUpscaler(Path({str(artifacts["live"])!r}), provider="openvino", threads=1)
    upscaler.warm_up(48, 64)
del upscaler
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "interrupted\n"), done.stderr
