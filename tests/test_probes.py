"""Hard cases on runtimes that are not there, or that keep states in a memory of their own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

from client.frames import Frame
from client.runtime import BFLOAT16, OrtRuntime, Tensor
from client.upscaler import OnnxUpscaler
from model.artifact_weights import network_of_artifact
from model.export import export_network
from model.planes import Network
from model.stability import CASES, run_cases
from model.trial import Outcome, Subject
from model.verify import Played, parity, play
from tests.moving import picture
from tests.networks import random_network


@pytest.fixture(scope="module")
def artifact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("probes") / "planes.onnx"
    export_network(random_network("planes", 2), path, name="planes", card={})
    return path


def subject(artifact: Path) -> Subject:
    return Subject(artifact, OnnxUpscaler(artifact, threads=1), network_of_artifact(artifact), [], 32, 24, full=False)


def outcome_of(tested: Subject, name: str) -> Outcome:
    ((_, outcome),) = run_cases(tested, [case for case in CASES if case.name == name])
    return outcome


class DeviceValue(ort.OrtValue):
    """A tensor that is not the array which it was made from, and is read by copying, as those of a GPU."""

    def numpy(self) -> np.ndarray:
        return super().numpy().copy()


@pytest.fixture
def device_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def tensor(self: OrtRuntime, array: np.ndarray, *, on_device: bool = False) -> Tensor:
        value = ort.OrtValue.ortvalue_from_numpy(array.copy() if on_device else array, "cpu", 0)
        if on_device:
            value.__class__ = DeviceValue
        there: Tensor = value
        return there

    monkeypatch.setattr(OrtRuntime, "tensor", tensor)
    monkeypatch.setattr(OrtRuntime, "has_own_memory", property(lambda _: True, lambda *_: None), raising=False)


def test_a_recurrent_artifact_is_verified_in_a_devices_own_memory(artifact: Path, request: pytest.FixtureRequest) -> None:
    frames = [picture(t, 24, 32) for t in range(4)]
    expected = list(parity(artifact, frames, 12))
    names = ("cuts", "lost-state", "denormals")
    found = {name: outcome_of(subject(artifact), name) for name in names}
    request.getfixturevalue("device_memory")
    assert list(parity(artifact, frames, 12)) == expected and expected[-1].rms_state_error > 0
    for name in names:
        there = outcome_of(subject(artifact), name)
        assert (there.steps, there.max_state_error, there.largest_state) == (
            found[name].steps,
            found[name].max_state_error,
            found[name].largest_state,
        )
        assert there.subnormals == 0 and not any("not caught" in failure for failure in there.failures)


@pytest.mark.parametrize("installed", [("cpu", "cuda"), ("cpu", "cuda", "openvino")])
def test_a_provider_that_does_not_start_is_no_failure_and_is_said(
    artifact: Path, monkeypatch: pytest.MonkeyPatch, installed: tuple[str, ...]
) -> None:
    monkeypatch.setattr("model.probes.is_installed", lambda name: name in installed)
    monkeypatch.setattr("client.artifact.ort.get_available_providers", lambda: ["CPUExecutionProvider"])
    outcome = outcome_of(subject(artifact), "providers")
    refusal = "; not cuda: this ONNX Runtime has no cuda provider"
    if "openvino" in installed:
        assert outcome.passed and outcome.remark.startswith(f"cpu and openvino{refusal}")
    else:
        assert outcome.passed is None and outcome.left_out.startswith(f"no other provider than cpu runs here{refusal}")


def test_providers_are_held_to_the_bounds_of_what_they_compute_in(artifact: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two codes are too many between two that compute in float32, also where the artifact is tested in bfloat16, which may be off by 4."""

    def play_with_a_sample_off(upscaler: OnnxUpscaler, network: Network | None, frames: Iterable[Frame]) -> Iterator[Played]:
        for played in play(upscaler, network, frames):
            luma = played.picture.y.copy()
            luma[0, 0] = 102 if upscaler.provider == "openvino" else 100
            yield replace(played, picture=replace(played.picture, y=luma))

    monkeypatch.setattr("model.probes.play", play_with_a_sample_off)
    tested = subject(artifact)
    tested.upscaler.provider = BFLOAT16
    assert tested.bounds.codes > 2
    assert outcome_of(tested, "providers").failures == ("providers differ",)
