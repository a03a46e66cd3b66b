"""The last layer solved: against independent least squares, against what the new artifact really does, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from client.artifact import load_session
from client.errors import InputError
from client.models import find_model
from model.export import export_baseline, export_network
from model.footage import Degradation, FootageCache, load_pairs, load_scenes
from model.losses import MSE_FLOOR
from model.refit import FRAMES, Refit, Sums, shares_of, solved, sums_of
from model.refit_cli import main
from tests.moving import write_footage
from tests.networks import random_network

HOW = ["area", "area", "area@100"]
CARD = {
    "command": "gamesr-train",
    "before": [],
    "commit": "unknown",
    "device": "CPU",
    "steps": 1,
    "training_seconds": 1,
    "footage": {"train": ["a/one"], "validate": ["a/four"]},
    "held_out": {},
}


def made_clip(rng: np.random.Generator, level: float) -> tuple[np.ndarray, np.ndarray, Sums]:
    x = rng.normal(size=(400, 6))
    e = level * (x @ rng.normal(size=(6, 5)) + rng.normal(size=(400, 5)))
    return x, e, Sums(x.T @ x / 400, x.T @ e / 400, (e**2).mean(0), np.ptp(x, 0))


def test_of_one_clip_it_is_least_squares() -> None:
    x, e, sums = made_clip(np.random.default_rng(0), 1)
    change = solved([(0.3, sums)], slice(1, 4))
    np.testing.assert_allclose(change, np.linalg.lstsq(x, e[:, 1:4], rcond=None)[0], rtol=1e-5)
    assert sums.after(change, slice(1, 4)) == pytest.approx(((e[:, 1:4] - x @ change) ** 2).mean())


def test_of_several_clips_the_logarithms_have_no_slope() -> None:
    """However small a clip's error is beside another's: a sum of squares would hardly know of it."""
    rng = np.random.default_rng(1)
    clips = [(share, made_clip(rng, level)[2]) for share, level in ((0.5, 1), (0.3, 30), (0.2, 0.1))]
    outputs = slice(0, 5)

    def total(change: np.ndarray) -> float:
        return sum(share * float(np.log(sums.after(change, outputs) + MSE_FLOOR)) for share, sums in clips)

    change = solved(clips, outputs)
    for _ in range(20):
        step = 1e-3 * rng.normal(size=change.shape)
        assert total(change) < min(total(change + step), total(change - step))
        assert abs(total(change + step) - total(change - step)) < 1e-4 * abs(total(0 * change) - total(change))


@pytest.mark.parametrize("level", [0, 1e-5])
def test_a_clip_that_is_right_already_does_not_take_all_the_weight(level: float) -> None:
    """A black fade-in, or a grey scene's chroma: features the same everywhere, and no error to speak of."""
    rng = np.random.default_rng(3)
    outputs = slice(0, 5)
    textured = made_clip(rng, 10)[2]
    alone = textured.after(solved([(1, textured)], outputs), outputs)
    x = np.repeat(rng.normal(size=(1, 6)), 400, 0)
    e = level * rng.normal(size=(400, 5))
    right = Sums(x.T @ x / 400, x.T @ e / 400, (e**2).mean(0), np.zeros(6))
    change = solved([(0.5, textured), (0.5, right)], outputs)
    assert textured.after(change, outputs) < textured.squared.mean() / 2 and alone < textured.squared.mean() / 4
    assert right.after(change, outputs) < 1 / 12  # what rounding to codes takes


def test_what_is_solved_for_rounded_features_is_the_least_error_with_them_rounded() -> None:
    rng = np.random.default_rng(4)
    x, e, _ = made_clip(rng, 1)
    x[:, 1] = x[:, 0] + 1e-3 * rng.normal(size=400)  # a difference that no rounding leaves
    weights, reach = rng.normal(size=(6, 5)), np.array([80.0, 80, 9, 3, 1, 0])
    exact = Sums(x.T @ x / 400, x.T @ e / 400, (e**2).mean(0), reach)
    noise = rng.uniform(-0.5, 0.5, (200, 400, 6)) * reach / 255

    def error(change: np.ndarray) -> float:
        return float(np.square(e - x @ change - noise @ (weights + change)).mean())

    robust, brittle = solved([(1, exact.rounded(reach, weights))], slice(0, 5)), solved([(1, exact)], slice(0, 5))
    assert error(robust) < error(brittle) and error(robust) == pytest.approx(
        exact.rounded(reach, weights).after(robust, slice(0, 5)), rel=0.01
    )


def test_games_and_scenes_count_alike_and_inputs_as_often_as_named() -> None:
    titles = ["a/one area", "a/one area@100", "a/two area", "b/three area", "b/three area@100"]
    assert shares_of(titles, HOW) == pytest.approx([1 / 3, 1 / 6, 1 / 2, 2 / 3, 1 / 3])


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_footage(tmp_path_factory.mktemp("refit"))


@pytest.fixture(autouse=True)
def all_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ninth of such small pictures is less than there are weights."""
    monkeypatch.setattr("model.refit.SHARE", 1)


def refitted(preset: str, scale: int, footage: Path, folder: Path) -> tuple[Path, Path]:
    before, after = folder / f"before_x{scale}.onnx", folder / f"after_x{scale}.onnx"
    export_network(random_network(preset, scale), before, name="before", card=CARD)
    command = [str(before), "after", str(footage), "--folder", str(folder), "--cache", str(footage.parent / "cache"), "--threads", "1"]
    assert main([*command, "--degradations", "area", "area", "area@0100"]) == 0
    return before, after


def weights(path: Path) -> dict[str, np.ndarray]:
    return {tensor.name: numpy_helper.to_array(tensor) for tensor in onnx.load(path).graph.initializer}


@pytest.mark.parametrize(("preset", "scale"), [("live", 2), ("fast", 2), ("planes", 2), ("planes-static-no-lstm", 2), ("fast", 3)])
def test_the_new_artifact_has_the_errors_that_were_solved_for(
    preset: str, scale: int, footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = refitted(preset, scale, footage, tmp_path)
    table, last = capsys.readouterr().out.rsplit("\n", 2)[:2]
    assert last == str(after) and table.splitlines()[0] == "| held out | input | PSNR-Y | PSNR-U | PSNR-V |"
    cache = FootageCache(footage.parent / "cache", FRAMES)
    pairs = [
        pair
        for split in ("train", "validate")
        for takes in load_pairs(load_scenes(footage, split=split), cache, scale, map(Degradation.parse, dict.fromkeys(HOW)))
        for pair in takes
    ]
    old, new = Refit(before), Refit(after)
    errors = {pair.title: [sums_of(refit.network, refit.layer, pair) for refit in (old, new)] for pair in pairs}
    shares = shares_of(list(errors), HOW)
    gained = []
    for plane in new._planes():
        train = [(share, errors[pair.title][0]) for share, pair in zip(shares, pairs, strict=True) if "four" not in pair.title]
        reach = np.max([sums.reach for _, sums in train], 0)
        change = solved([(share, sums.rounded(reach, old._weights())) for share, sums in train], plane)
        for sums, better in errors.values():
            assert better.squared[plane].mean() == pytest.approx(sums.after(change, plane), rel=2e-3, abs=1e-6)
            gained.append(10 * np.log10(sums.squared[plane].mean() / better.squared[plane].mean()))
    assert min(gained) > 0.01  # every scene is the same clip: what is solved on some of them is better in the others too
    row = [float(cell) for cell in table.splitlines()[2].split("|")[3:6]]
    assert table.splitlines()[2].startswith("| a | area |") and min(row) > 0.01
    twice = Refit(after)
    twice.train = {title: sums[1] for title, sums in errors.items() if "four" not in title}
    twice.held_out = twice.train
    assert max(abs(luma) for luma, *_ in twice.solve(HOW).values()) < 1e-3  # there is no more to be had; chroma's error is all rounding


def test_all_else_stays_as_it_was_and_the_card_says_what_was_done(footage: Path, tmp_path: Path) -> None:
    before, after = refitted("fast", 2, footage, tmp_path)
    old, new = weights(before), weights(after)
    changed = {name for name in old if not np.array_equal(old[name], new[name])}
    assert changed == {f"network.{head}.{part}" for head in ("head", "chroma_head") for part in ("features.weight", "cells.bias")}
    assert [node.SerializeToString() for node in onnx.load(after).graph.node] == [
        node.SerializeToString() for node in onnx.load(before).graph.node
    ]
    specs = [load_session(path, "cpu", 1)[1] for path in (before, after)]
    assert specs[1].name == "after" and specs[1].reach == specs[0].reach
    card = dict(specs[1].card)
    facts = card.pop("refit")
    assert card == specs[0].card and facts["scenes"] == ["a/one", "b/two", "b/three"] and facts["degradations"] == HOW
    page = after.with_suffix(".md").read_text()
    assert f"the last layer is solved on the first {FRAMES} frames of each scene (area area area@100)" in page
    assert "PSNR-Y in dB, before it was refitted:" in page


def test_what_does_not_end_in_one_layer_is_refused(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export_network(random_network("paper"), tmp_path / "paper_x2.onnx", name="paper", card=CARD)
    export_baseline("bicubic", 2, tmp_path / "bicubic_x2.onnx", name="bicubic")
    told = {
        str(tmp_path / "paper_x2.onnx"): "more than one layer between its features and its picture",
        str(tmp_path / "bicubic_x2.onnx"): "is no network",
        "live-int8": "is int8: refit the float32 artifact",
        "nothing": "nothing",
    }
    for model, reason in told.items():
        assert main([model, "new", str(footage), "--folder", str(tmp_path)]) == 1
        assert reason in capsys.readouterr().err
    assert not list(tmp_path.glob("new*"))


def test_footage_with_nothing_to_solve_for_is_refused(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "footage.toml").write_text(footage.read_text().replace('"train"', '"validate"'))
    assert main(["fast", "new", str(tmp_path / "footage.toml"), "--folder", str(tmp_path), "--cache", str(tmp_path / "cache")]) == 1
    assert "has no train scene" in capsys.readouterr().err
    refit = Refit(find_model("fast", 2))
    with pytest.raises(InputError, match="no training scene has a film of such an input"):
        refit.solve(HOW)
