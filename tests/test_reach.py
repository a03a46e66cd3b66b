"""How far a picture looks: counted by hand for the networks, and true of the artifacts to the pixel."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from client.artifact import load_session
from client.errors import ModelError
from client.models import shipped_models
from model.lean import LEAN
from model.network import PRESETS
from model.planes import Planes
from model.reach import MAX_CELLS, network_reach, reach
from tests.networks import random_network


@pytest.mark.parametrize("preset", ["planes", "planes-no-lstm", "paper-no-lstm"])
def test_a_network_reaches_as_far_as_its_convolutions_in_a_row(preset: str) -> None:
    network = random_network(preset).deployed().double()
    config = network.config
    cells = 1 + config.blocks + config.recurrent + 1  # stem, blocks, ConvLSTM, head: each looks one cell around
    ends = 2 if config.colour == "rgb" else 0  # chroma interpolated on the way in, and a tail over the picture
    assert network_reach(network) == (cells + ends) * config.size_multiple


@pytest.mark.parametrize("preset", LEAN)
def test_a_lean_network_reaches_as_far_as_it_extends_the_picture(preset: str) -> None:
    network = random_network(preset).deployed().double()
    assert network_reach(network) == (1 + network.config.blocks + 1) * 2


def test_every_preset_has_an_end() -> None:
    assert all(network_reach(random_network(preset).deployed().double()) for preset in (*PRESETS, *LEAN))


def test_an_average_over_the_picture_has_none() -> None:
    assert reach(lambda frame: [frame.y - frame.y.mean()], 2) is None
    assert reach(lambda frame: [torch.roll(frame.u, 3, 2)], 2) == 6
    assert reach(lambda frame: [torch.roll(frame.y, MAX_CELLS * 2, 3)], 2) == MAX_CELLS * 2
    assert reach(lambda frame: [torch.roll(frame.y, MAX_CELLS * 2 + 2, 3)], 2) is None
    assert reach(lambda frame: Planes(frame.y, 0 * frame.u, frame.v), 2) == 0


def test_every_shipped_model_says_it() -> None:
    """Interpolation of chroma decides for the baselines: two samples around, three of Lanczos, are four and six of luma."""
    interpolations = {"bicubic": 4, "lanczos": 6, "easu": 6, "fsr1": 6}
    networks = {"fast": 6, "live": 6, "balanced": 6, "quality": 14, "gamesr": 16, "gamesr-paper": 20}
    in_int8 = {f"{name}-int8": networks[name] for name in ("fast", "live", "balanced")}
    assert {path.stem: load_session(path, "cpu", 1)[1].reach for path in shipped_models()} == {
        f"{name}_x{scale}": pixels for name, pixels in {**interpolations, **networks, **in_int8}.items() for scale in (2, 3)
    }


@pytest.mark.parametrize("reach", ["-2", "3", "4096", "far"])
def test_a_reach_that_cannot_be_is_refused(model_file: Callable[..., Path], reach: str) -> None:
    with pytest.raises(ModelError, match=r"tiny\.onnx is not a model that this client understands"):
        load_session(model_file(metadata={"reach": reach}), "cpu", 1)


def test_an_older_artifact_says_nothing_of_it(model_file: Callable[..., Path]) -> None:
    assert load_session(model_file(), "cpu", 1)[1].reach is None
