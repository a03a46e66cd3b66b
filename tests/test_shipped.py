"""The artifacts that ship: small, with a card, sound, and better than bicubic on a map that none of them saw."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import onnx
import openvino
import pytest
from onnx import TensorProto, shape_inference

from client.cloud import area_downscale
from client.frames import Frame
from client.models import find_model, shipped_models
from client.quality import psnr_db, squared_error
from client.runtime import BFLOAT16
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from model.artifact_weights import network_of_artifact
from model.stability import CASES, run_cases
from model.trial import BOUNDS, Subject
from model.verify import crop, parity

REFERENCE = Path(__file__).parent / "footage" / "oa_koth1_1080p.mp4"
UNTRAINED, NETWORKS = ("bicubic", "lanczos", "easu", "fsr1"), ("gamesr", "gamesr-paper", "quality", "balanced", "live", "fast")
IN_INT8 = ("balanced", "live", "fast")
TIERS = ("fast", "live", "balanced", "quality", "gamesr", "fast-int8", "live-int8", "balanced-int8")
STEPS = {"noise": 6, "still": 140, "sizes": 2}
NEEDS_BFLOAT16 = pytest.mark.skipif(
    "BF16" not in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"), reason="this processor does not compute in bfloat16"
)
TRAINED = [path for path in shipped_models() if path.stem.rpartition("_")[0] not in UNTRAINED]


@pytest.fixture(scope="module")
def references() -> list[Frame]:
    return [crop(frame, 576, 324) for frame in islice(read_frames(REFERENCE), 4)]


def psnr_y_db(path: Path, references: list[Frame]) -> float:
    upscaler = OnnxUpscaler(path, threads=1)
    low = [area_downscale(frame, upscaler.spec.scale) for frame in references]
    state = upscaler.initial_state(low[0].height, low[0].width)
    total = 0
    for frame, reference in zip(low, references, strict=True):
        picture, state = upscaler.step(frame, state)
        total += squared_error(reference.y, picture.y)
    return psnr_db(total / (references[0].y.size * len(references)))


def test_every_model_that_the_readme_names_ships() -> None:
    names = (*UNTRAINED, *NETWORKS, *(f"{name}-int8" for name in IN_INT8))
    expected = {f"{name}_x{scale}" for name in names for scale in (2, 3)}
    assert {path.stem for path in shipped_models()} == expected


@pytest.mark.parametrize("path", shipped_models(), ids=lambda path: path.stem)
def test_no_shipped_model_leaves_the_gpu_in_the_middle_of_a_frame(path: Path) -> None:
    """ONNX Runtime has no CUDA kernel of DepthToSpace for uint8: it would copy the samples to the processor and shuffle them there."""
    graph = shape_inference.infer_shapes(onnx.load(path)).graph
    types = {value.name: value.type.tensor_type.elem_type for value in (*graph.value_info, *graph.input, *graph.output)}
    shuffled = [types[node.input[0]] for node in graph.node if node.op_type == "DepthToSpace"]
    assert TensorProto.UINT8 not in shuffled


@pytest.mark.parametrize("path", shipped_models(), ids=lambda path: path.stem)
def test_a_model_says_nothing_of_the_machine_that_made_it(path: Path) -> None:
    content = path.read_bytes()
    assert not any(word in content for word in (b"site-packages", b".py", b"/home", b"/root", b"/work", b"/tmp"))


@pytest.mark.parametrize("path", TRAINED, ids=lambda path: path.stem)
def test_a_trained_model_is_small_documented_and_beats_bicubic(path: Path, references: list[Frame]) -> None:
    assert path.stat().st_size < 1_000_000
    spec = OnnxUpscaler(path, threads=1).spec
    assert f"{spec.card['command']}" in path.with_suffix(".md").read_text()
    assert not any("oa_koth1" in scene for scenes in spec.card["footage"].values() for scene in scenes)
    # 0.3 dB is far below what each reaches (the README's table) and far above what a damaged one would
    assert psnr_y_db(path, references) > psnr_y_db(find_model("bicubic", spec.scale), references) + 0.3


@pytest.mark.parametrize("path", [path for path in TRAINED if "int8" not in path.stem], ids=lambda path: path.stem)
def test_a_trained_model_is_its_float64_reference(path: Path, references: list[Frame]) -> None:
    low = [crop(frame, 96, 72) for frame in references]
    errors = list(parity(path, low, 20))
    assert max(error.max_code_error for error in errors) <= 1
    assert np.mean([error.rms_state_error for error in errors[10:]]) < 1e-5


@pytest.mark.parametrize("scale", [2, 3])
@pytest.mark.parametrize("name", IN_INT8)
def test_an_int8_model_is_its_float32_original_within_its_bounds(name: str, scale: int, references: list[Frame]) -> None:
    """And as good as the tier of that name, from whose weights the original's began."""
    rounded, exact = find_model(f"{name}-int8", scale), find_model(name, scale)
    ours, theirs = (OnnxUpscaler(path, threads=1).spec for path in (rounded, exact))
    assert ours.precision == "int8" and theirs.card["command"] in (run["command"] for run in (ours.card, *ours.card["before"]))
    errors = list(parity(rounded, [crop(frame, 96, 72) for frame in references], 8))
    assert 0 < max(error.max_code_error for error in errors) <= BOUNDS["int8"].codes
    assert psnr_y_db(rounded, references) > psnr_y_db(exact, references) - 0.1


@pytest.mark.parametrize(("scale", "provider"), [(2, "cpu"), (3, "cpu"), pytest.param(2, BFLOAT16, marks=NEEDS_BFLOAT16)])
@pytest.mark.parametrize("name", TIERS)
def test_a_tier_keeps_its_bounds_in_noise_in_a_still_and_in_odd_sizes(name: str, scale: int, provider: str) -> None:
    """In fewer frames than `gamesr-verify --hard short` plays, and smaller ones; int8 against the float32 weights that it was made from."""
    path = find_model(name, scale)
    subject = Subject(path, OnnxUpscaler(path, provider=provider, threads=1), network_of_artifact(path), [], 32, 24, full=False)
    cases = [replace(case, short=STEPS[case.name]) for case in CASES if case.name in STEPS]
    outcomes = {case.name: outcome for case, outcome in run_cases(subject, cases)}
    assert all(outcome.passed for outcome in outcomes.values()), outcomes
