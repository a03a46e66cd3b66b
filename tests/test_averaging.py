"""Weights between two runs: those that run are averaged, whatever form they are trained in; the card says of what."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from client.errors import InputError, ModelError
from client.models import find_model
from model.artifact_weights import network_of_artifact
from model.averaging import averaged
from model.export import export_network
from model.planes import Network
from tests.networks import random_network


def running(network: Network) -> dict[str, torch.Tensor]:
    return {name: weight.detach().double() for name, weight in network.eval().deployed().state_dict().items()}


@pytest.mark.parametrize("preset", ["live", "fast", "planes", "planes-static-no-lstm"])
def test_what_runs_lies_between_the_two(tmp_path: Path, preset: str) -> None:
    ours, theirs = random_network(preset, 2), random_network(preset, 2, seed=1)
    export_network(theirs, tmp_path / "theirs_x2.onnx", name="theirs", card={})
    between = averaged(ours, tmp_path / "theirs_x2.onnx", 0.25)
    other = network_of_artifact(tmp_path / "theirs_x2.onnx").state_dict()
    found, mine = running(between), running(ours)
    assert found.keys() == mine.keys()
    moved = 0
    for name, weight in mine.items():
        expected = 0.75 * weight + 0.25 * other[name]
        tolerance = 8e-3 if preset in ("live", "fast") and "head." in name else 1e-5  # whose base is of bfloat16's numbers
        torch.testing.assert_close(found[name], expected, rtol=tolerance, atol=tolerance, msg=name)
        moved += not torch.allclose(weight, expected, rtol=1e-3, atol=1e-3)
    assert moved > 3


def test_rounded_weights_are_not_averaged_under_their_name() -> None:
    """What network_of_artifact gives are those of the float32 artifact that it was made from."""
    artifact = find_model("fast-int8", 2)
    with pytest.raises(ModelError, match="has rounded weights: average with the float32 artifact that it was made from"):
        averaged(random_network("fast", 2), artifact, 0.5)


def test_nothing_else_is_averaged(tmp_path: Path) -> None:
    export_network(random_network("live", 3), tmp_path / "live_x3.onnx", name="live", card={})
    with pytest.raises(ModelError, match="is another network than the checkpoint's"):
        averaged(random_network("live", 2), tmp_path / "live_x3.onnx", 0.5)
    for share in (0, 1, -0.1, float("nan")):
        with pytest.raises(InputError, match="between 0 and 1"):
            averaged(random_network("live", 3), tmp_path / "live_x3.onnx", share)
