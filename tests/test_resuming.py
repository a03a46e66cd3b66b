"""Runs that go on: to the weights and the card of one that was never stopped, or not at all; and checkpoints that are none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from client.errors import InputError, ModelError
from model.export_cli import main as export_main
from model.footage import FootageCache
from model.train import TrainConfig, Trainer, load_checkpoint, network_of
from tests.moving import scene, write_footage

TINY = TrainConfig(degradations=("area", "area@300"), steps=8, batch=2, patch=16, frames=4, window=2, warm_up_steps=2)


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_footage(tmp_path_factory.mktemp("footage"))


@pytest.fixture
def trainer(footage: Path, tmp_path: Path) -> Callable[..., Trainer]:
    """One of a configuration in a folder of this name; with `steps`, saved after as many."""

    def make(name: str, config: TrainConfig = TINY, footage: Path = footage, steps: int = 0) -> Trainer:
        trainer = Trainer(config, footage, FootageCache(tmp_path / "cache"), tmp_path / name)
        losses = trainer.losses()
        for _ in range(steps):
            next(losses)
        if steps:
            trainer.save()
        return trainer

    return make


@pytest.mark.parametrize("config", [TINY, replace(TINY, preset="fast", int8=True)], ids=["planes", "int8"])
def test_a_resumed_run_ends_at_the_same_weights(trainer: Callable[..., Trainer], tmp_path: Path, config: TrainConfig) -> None:
    trainer("whole", config).run(validate_every=100, progress=False)
    trainer("parts", config, steps=4)
    trainer("parts", config).run(validate_every=100, progress=False)
    whole, parts = (load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    assert whole["step"] == parts["step"] == 8
    for name, weight in whole["network"].items():
        assert torch.equal(weight, parts["network"][name]), name


def test_a_resumed_run_says_what_it_was_built_on_and_not_what_has_become_of_that(trainer: Callable[..., Trainer], tmp_path: Path) -> None:
    trainer("first", steps=2)
    weights = tmp_path / "first" / "checkpoint.pt"
    config = replace(TINY, initial_weights=str(weights))
    trainer("second", config, steps=4)
    trainer("first").run(validate_every=100, progress=False)
    trainer("second", config).save()
    assert [run["step"] for run in load_checkpoint(tmp_path / "second" / "checkpoint.pt")["before"]] == [2]
    weights.unlink()
    assert trainer("second", config).step == 4
    with pytest.raises(ModelError, match="cannot be read: No such file"):
        trainer("third", config)
    assert not (tmp_path / "third").exists()


def test_a_run_does_not_go_on_with_other_footage(trainer: Callable[..., Trainer], footage: Path) -> None:
    trainer("run", steps=2)
    other = footage.with_name("other.toml")
    other.write_text(footage.read_text() + scene("six", "a", "train", "clip.mkv"))
    with pytest.raises(InputError, match=r"holds a run of other footage \(train\): choose another folder"):
        trainer("run", footage=other)
    other.write_text("\n" + footage.read_text())  # the same scenes, wherever they lie
    trainer("run", footage=other)


def test_a_run_of_a_version_with_fewer_options_goes_on(trainer: Callable[..., Trainer], tmp_path: Path) -> None:
    trainer("run", steps=2)
    change(tmp_path / "run" / "checkpoint.pt", lambda saved: saved["config"].pop("int8"))
    assert trainer("run").step == 2
    with pytest.raises(InputError, match=r"another configuration \(preset, int8\)"):
        trainer("run", replace(TINY, preset="fast", int8=True))


def change(checkpoint: Path, how: Callable[[dict[str, Any]], object]) -> None:
    saved = torch.load(checkpoint, weights_only=True)
    how(saved)
    torch.save(saved, checkpoint)


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        (lambda saved: saved["config"].update(momentum=0.9), "is of a configuration that this version does not know: .*'momentum'"),
        (lambda saved: saved["config"].update(preset="huge"), "does not know: no network is called 'huge'"),
        (lambda saved: saved.update(config=3), "is of a configuration that this version does not know"),
        (lambda saved: saved.pop("config"), "is not a whole checkpoint: it lacks config"),
        (lambda saved: saved.pop("device"), "is not a whole checkpoint: it lacks device"),
        (lambda saved: saved["network"].pop("stem.weight"), "has other weights than"),
        (lambda saved: saved["network"].update({"stem.weight": torch.zeros(3)}), "has other weights than"),
        (lambda saved: saved.update(network=3), "has other weights than"),
    ],
)
def test_a_checkpoint_of_another_making_is_one_sentence(
    trainer: Callable[..., Trainer],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    how: Callable[[dict[str, Any]], object],
    sentence: str,
) -> None:
    trainer("run", steps=2)
    change(tmp_path / "run" / "checkpoint.pt", how)
    with pytest.raises(ModelError, match=sentence):
        trainer("run")
    with pytest.raises(ModelError, match=sentence):
        network_of(load_checkpoint(tmp_path / "run" / "checkpoint.pt"))
    assert export_main([str(tmp_path / "run" / "checkpoint.pt"), "mine", "--folder", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_checkpoint_without_its_optimizers_state_does_not_go_on(trainer: Callable[..., Trainer], tmp_path: Path) -> None:
    trainer("run", steps=2)
    change(tmp_path / "run" / "checkpoint.pt", lambda saved: saved["optimizer"].pop("param_groups"))
    with pytest.raises(ModelError, match="has other weights than a run of its own configuration"):
        trainer("run")


def test_a_file_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"nothing")
    with pytest.raises(ModelError, match="not a checkpoint"):
        load_checkpoint(tmp_path / "checkpoint.pt")
