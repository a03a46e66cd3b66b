"""Training on from an artifact: its network's training form gives what it gives, learns, and says where it began."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path

import pytest
import torch

from client.errors import GamesrError, ModelError
from client.models import find_model
from client.upscaler import OnnxUpscaler
from model.artifact_weights import network_of_artifact, refitting, run_of_artifact
from model.catalogue import network_of_preset
from model.complexity import parameter_count
from model.export import export_baseline, export_network
from model.footage import FootageCache
from model.lean import Lean, LeanConfig
from model.train import TrainConfig, Trainer
from tests.moving import write_footage
from tests.networks import random_clip, random_network

TINY = TrainConfig(degradations=("area",), steps=4, batch=2, patch=16, frames=4, window=2, warm_up_steps=2)


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_footage(tmp_path_factory.mktemp("footage"))


@pytest.mark.parametrize(
    ("preset", "scale"),
    [("planes", 2), ("planes-static", 3), ("paper", 2), ("fast", 2), ("fast", 3), ("live", 3), ("balanced", 2), ("srvgg", 2), ("imdn", 3)],
)
def test_the_training_form_gives_what_the_artifact_gives(preset: str, scale: int, tmp_path: Path) -> None:
    path = tmp_path / "network.onnx"
    network = random_network(preset, scale)
    export_network(network, path, name=preset, card={})
    run = run_of_artifact(path)
    assert (run["preset"], run["before"]) == (preset, [])
    again = network_of_preset(preset, scale)
    assert parameter_count(again) == parameter_count(network)
    again.load_state_dict(run["network"])
    clip = random_clip(1, 3, 24, 40)
    expected, _ = network_of_artifact(path)(clip)
    for form in (again.double(), again.deployed()):
        found, _ = form(clip)
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0.02)  # codes; a rounded kernel may fall to its neighbour in bfloat16


@pytest.mark.parametrize("name", ["live", "quality", "gamesr"])
def test_a_run_goes_on_from_an_artifact_that_ships(name: str, footage: Path, tmp_path: Path) -> None:
    artifact = find_model(name, 2)
    preset = {"live": "live", "quality": "planes-static-no-lstm", "gamesr": "planes"}[name]
    config = TrainConfig(**{**TINY.__dict__, "preset": preset, "initial_weights": str(artifact), "learning_rate": 1e-4})
    trainer = Trainer(config, footage, FootageCache(tmp_path / "cache"), tmp_path / "run")
    clip = random_clip(1, 3, 24, 40)
    expected, _ = network_of_artifact(artifact)(clip)
    found, _ = copy.deepcopy(trainer.network).double()(clip)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0.02)  # codes
    next(trainer.losses())
    card = OnnxUpscaler(artifact, threads=1).spec.card
    refitted = [refitting(card["refit"])] if "refit" in card else []
    assert [run["command"] for run in trainer.before] == [*(run["command"] for run in card["before"]), card["command"], *refitted]
    began = network_of_preset(preset, 2)
    began.load_state_dict(run_of_artifact(artifact)["network"])
    moved = [not torch.equal(now, described) for now, described in zip(trainer.network.parameters(), began.parameters(), strict=True)]
    assert all(moved)


def test_that_an_artifact_was_averaged_is_among_what_made_it(tmp_path: Path) -> None:
    run = {"command": "gamesr-train footage.toml run", "steps": 3, "training_seconds": 1}
    card = {**run, "averaged": {"with": "abc", "share": 0.2}}
    export_network(random_network("live", 2), tmp_path / "live.onnx", name="live", card=card)
    said = "20% of the weights are those of the artifact abc (SHA-256), from which the run began"
    assert run_of_artifact(tmp_path / "live.onnx")["before"] == [run, {"command": said, "steps": 0, "training_seconds": 0}]


def test_blocks_that_the_artifact_does_not_have_begin_as_nothing(footage: Path, tmp_path: Path) -> None:
    artifact = tmp_path / "shallow.onnx"
    export_network(Lean(LeanConfig(blocks=0)), artifact, name="shallow", card={})
    config = TrainConfig(**{**TINY.__dict__, "preset": "live", "initial_weights": str(artifact)})
    deeper = Trainer(config, footage, FootageCache(tmp_path / "cache"), tmp_path / "run").network
    assert torch.equal(deeper.stem.weight, run_of_artifact(artifact)["network"]["stem.weight"])
    assert [bool(block.conv.compress.weight.any()) for block in deeper.blocks] == [False]


@pytest.mark.parametrize("scale", [2, 3])
def test_a_wide_network_begins_as_the_narrow_one_and_learns_to_use_its_width(scale: int, footage: Path, tmp_path: Path) -> None:
    """All features beyond the artifact's are drawn and unread; another scale keeps its own head and base, as ever."""
    artifact, cache = find_model("live", scale), FootageCache(tmp_path / "cache")
    given = {**TINY.__dict__, "preset": "live-wide", "initial_weights": str(artifact)}
    trainer = Trainer(TrainConfig(**{**given, "scale": scale}), footage, cache, tmp_path / "same")
    clip = random_clip(1, 3, 24, 40)
    expected, _ = network_of_artifact(artifact)(clip)
    found, _ = copy.deepcopy(trainer.network).double()(clip)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0.02)  # codes
    narrow = LeanConfig().features
    assert trainer.network.stem.weight[narrow:].any() and not trainer.network.head.weight[:, narrow:].any()
    list(itertools.islice(trainer.losses(), 2))
    assert trainer.network.head.weight[:, narrow:].any() and trainer.network.blocks[0].conv.expand.weight[:, narrow:].any()
    other = Trainer(TrainConfig(**{**given, "scale": 5 - scale}), footage, cache, tmp_path / "other").network
    assert torch.equal(other.stem.weight[:narrow], run_of_artifact(artifact)["network"]["stem.weight"]) and not other.head.weight.any()


def test_an_artifact_without_weights_to_train_is_refused(footage: Path, tmp_path: Path) -> None:
    export_baseline("bicubic", 2, tmp_path / "bicubic.onnx", name="bicubic")
    (tmp_path / "foreign.onnx").write_bytes(b"no model at all")
    for path, message in (
        (tmp_path / "bicubic.onnx", "is no network"),
        (find_model("live-int8", 2), "has rounded weights: begin with the float32 artifact"),
        (tmp_path / "foreign.onnx", "foreign.onnx"),
        (tmp_path / "missing.onnx", "missing.onnx"),
    ):
        config = TrainConfig(**{**TINY.__dict__, "initial_weights": str(path)})
        with pytest.raises(GamesrError, match=message):
            Trainer(config, footage, FootageCache(tmp_path / "cache"), tmp_path / "run")
    wider = TrainConfig(**{**TINY.__dict__, "preset": "live", "initial_weights": str(find_model("balanced", 2))})
    with pytest.raises(ModelError, match="no weight that fits this network: it is one of --preset balanced"):
        Trainer(wider, footage, FootageCache(tmp_path / "cache"), tmp_path / "run")
    for preset in ("fsrcnn", "live"):
        config = TrainConfig(**{**TINY.__dict__, "preset": preset, "initial_weights": str(find_model("gamesr", 2))})
        with pytest.raises(ModelError, match="no weight that fits this network: it is one of --preset planes"):
            Trainer(config, footage, FootageCache(tmp_path / "cache"), tmp_path / "run")
