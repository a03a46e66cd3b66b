"""LPIPS as a file of the user's: what it is given, what it may be, and what is said where it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from client.errors import ModelError
from client.frames import BT709_LIMITED, Frame
from server.events import PointFailed
from server.lpips import EVERY, Lpips
from tests.sweeping import plan_of, results, sweep_here


def distance_model(path: Path, *, kind: int = TensorProto.FLOAT, inputs: int = 2, mean: bool = True, gain: float = 1.0) -> Path:
    """gain times the mean squared difference of two pictures of any size; without `mean` a picture of it."""
    names = ["reference", "measured", "third"][:inputs]
    nodes = [helper.make_node("Sub", names[:2] if inputs > 1 else names * 2, ["d"]), helper.make_node("Mul", ["d", "d"], ["s"])]
    nodes.append(
        helper.make_node("ReduceMean", ["s"], ["m"], axes=[2, 3], keepdims=1) if mean else helper.make_node("Identity", ["s"], ["m"])
    )
    nodes.append(helper.make_node("ReduceMean", ["m"], ["n"], axes=[1], keepdims=1))
    nodes.append(helper.make_node("Mul", ["n", "gain"], ["out"]))
    graph = helper.make_graph(
        nodes,
        "distance",
        [helper.make_tensor_value_info(name, kind, [1, 3, "h", "w"]) for name in names],
        [helper.make_tensor_value_info("out", kind, None)],
        [helper.make_tensor("gain", kind, [], [gain])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


def grey(code: int) -> Frame:
    planes = [np.full(shape, value, np.uint8) for shape, value in (((8, 12), code), ((4, 6), 128), ((4, 6), 128))]
    return Frame(planes[0], planes[1], planes[2], colour=replace(BT709_LIMITED, range=2))


def test_pictures_go_in_as_rgb_from_minus_one_to_one_and_every_tenth_counts(tmp_path: Path) -> None:
    lpips = Lpips(distance_model(tmp_path / "d.onnx"), threads=1)
    assert lpips.distance(grey(0), grey(255)) == pytest.approx(4) and lpips.distance(grey(9), grey(9)) == 0
    for index in range(EVERY + 1):
        lpips.add(index, grey(0), grey(255 if index % EVERY == 0 else 0))
    assert lpips.result() == pytest.approx(4)


def test_it_is_on_the_point_and_in_its_key(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    clip, one, two = make_clip(width=96, height=72), distance_model(tmp_path / "1.onnx"), distance_model(tmp_path / "2.onnx", gain=2.0)
    plans = [plan_of(clip, upscalers="bicubic", heights=[36], bitrates=[200], lpips=file) for file in (None, one, two)]
    assert len({plan.points[0].key for plan in plans}) == 3
    none, first, second = (next(iter(results(sweep_here(plan, tmp_path / "store")).values())) for plan in plans)
    assert none.lpips is None and first.lpips is not None and first.lpips_undefined is None
    assert 0 < first.lpips < 1 and second.lpips == pytest.approx(2 * first.lpips) and first.quality == none.quality


def test_a_number_that_is_not_finite_is_not_kept(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    model = distance_model(tmp_path / "inf.onnx", gain=float("inf"))
    plan = plan_of(make_clip(width=96, height=72), upscalers="bicubic", heights=[36], bitrates=[200], lpips=model)
    (found,) = results(sweep_here(plan, tmp_path / "store")).values()
    assert found.lpips is None and "not finite" in str(found.lpips_undefined) and found.quality.psnr_y_db is not None


def test_other_files_are_refused_in_one_sentence(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    clip, text = make_clip(width=96, height=72), tmp_path / "text.onnx"
    text.write_text("no model")
    half, lone = distance_model(tmp_path / "h.onnx", kind=TensorProto.DOUBLE), distance_model(tmp_path / "l.onnx", inputs=1)
    for path, sentence in (
        (tmp_path / "none.onnx", "cannot be read"),
        (Path("/dev/null"), "is not a file"),
        (text, "not a readable ONNX model"),
        (half, "is not LPIPS"),
        (lone, "is not LPIPS"),
        (distance_model(tmp_path / "picture.onnx", mean=False), "must give one number"),
    ):
        with pytest.raises(ModelError, match=sentence) as caught:
            plan_of(clip, lpips=path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_file_for_one_size_is_refused_for_another(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    path = distance_model(tmp_path / "fixed.onnx")
    model = onnx.load(str(path))
    for tensor in model.graph.input:
        for dimension, value in zip(tensor.type.tensor_type.shape.dim, (1, 3, 64, 64), strict=True):
            dimension.dim_value = value
    onnx.save(model, str(path))
    with pytest.raises(ModelError, match="pictures of 96x72"):
        plan_of(make_clip(width=96, height=72), lpips=path)


def test_one_that_fails_in_mid_sweep_fails_its_points_only(make_clip: Callable[..., Path], tmp_path: Path) -> None:
    path = distance_model(tmp_path / "d.onnx")
    plan = plan_of(make_clip(width=96, height=72), upscalers="bicubic", heights=[36], bitrates=[200], lpips=path)
    path.unlink()
    (failed,) = [event for event in sweep_here(plan, tmp_path / "store") if isinstance(event, PointFailed)]
    assert "cannot be read" in failed.reason
