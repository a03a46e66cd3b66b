"""LayerNorms in OpenVINO: found in what ships, the same numbers, and left alone where they are not what they seem."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openvino
import pytest
from openvino import opset13 as ops

from client.models import shipped_models
from client.norms import norms_in_place

NORMS = {"gamesr": 5, "gamesr-paper": 5}


def kinds(model: Any) -> list[str]:
    return [node.get_type_name() for node in model.get_ordered_ops()]


@pytest.mark.parametrize("path", shipped_models(), ids=lambda path: path.stem)
def test_every_norm_that_ships_is_found(path: Path) -> None:
    model = openvino.Core().read_model(path)
    assert norms_in_place(openvino, model) == NORMS.get(path.stem.rpartition("_")[0], 0)
    assert "MVN" not in kinds(model)


def layer_norm(
    axes: list[int] | None = None,
    back: tuple[int, ...] = (0, 3, 1, 2),
    *,
    eps_mode: str = "inside_sqrt",
    variance: bool = True,
    scale_shape: tuple[int, ...] = (8,),
    scale_first: bool = False,
    dtype: type = np.float32,
    seen: Callable[[Any], Any] = lambda x: x,
) -> Any:
    """A model of one norm over 8 channels; `seen` is computed from the values before they are transposed back."""
    rng = np.random.default_rng(1)
    scale, shift = (ops.constant(rng.normal(1, 0.3, shape).astype(dtype)) for shape in (scale_shape, (8,)))
    given = ops.parameter([1, 8, 5, 7], dtype)
    last = ops.transpose(given, ops.constant([0, 2, 3, 1]))
    norm = ops.mvn(last, ops.constant(axes or [-1]), variance, 1e-5, eps_mode)
    scaled = ops.multiply(scale, norm) if scale_first else ops.multiply(norm, scale)
    return openvino.Model([ops.transpose(seen(ops.add(scaled, shift)), ops.constant(list(back)))], [given])


def computed(model: Any, given: np.ndarray) -> np.ndarray:
    (found,) = openvino.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})([given]).values()
    return np.array(found)


def test_a_norm_in_place_gives_what_it_gave_behind_transpositions() -> None:
    given = np.random.default_rng(2).normal(3, 2, (1, 8, 5, 7)).astype(np.float32)
    model = layer_norm()
    expected = computed(model, given)
    assert norms_in_place(openvino, model) == 1 and not {"MVN", "Transpose"} & set(kinds(model))
    assert np.abs(computed(model, given) - expected).max() < 1e-5


@pytest.mark.parametrize(
    "other",
    [
        {"axes": [-2, -1]},
        {"back": (0, 3, 2, 1)},
        {"eps_mode": "outside_sqrt"},
        {"variance": False},
        {"scale_shape": (5, 7, 8)},
        {"scale_first": True},
        {"dtype": np.float16},
        {"seen": lambda x: ops.add(x, ops.relu(x))},
    ],
    ids=lambda other: next(iter(other)),
)
def test_what_only_looks_like_one_is_left_alone(other: dict[str, Any]) -> None:
    model = layer_norm(**other)
    before = kinds(model)
    assert norms_in_place(openvino, model) == 0 and kinds(model) == before
