"""gamesr-frontier: what is on it, gains over bicubic by hand, and the command on a small clip."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.frontier import PROGRAM, frontier, gains_over_bicubic, main

POINTS = st.lists(st.tuples(st.integers(1, 9), st.integers(-9, 9)), min_size=1, max_size=12)


@given(POINTS)
def test_the_frontier_is_what_nothing_dominates(points: list[tuple[float, float]]) -> None:
    """Along it, cost and gain rise together; whatever is not on it is dominated by something that is."""
    on = frontier(points)
    best = sorted({point for point, is_on in zip(points, on, strict=True) if is_on})
    assert best == sorted(best, key=lambda point: point[1])
    assert len({cost for cost, _ in best}) == len({gain for _, gain in best}) == len(best) >= 1
    for (cost, gain), is_on in zip(points, on, strict=True):
        assert is_on == ((cost, gain) in best)
        assert any(c <= cost and g >= gain for c, g in best)


def row(clip: str, model: str, y: float, u: float, v: float) -> dict[str, Any]:
    return {"clip": clip, "model": model, "psnr_y_db": y, "psnr_u_db": u, "psnr_v_db": v, "vmaf_neg": 70.0 if model == "ours" else None}


def test_gains_are_means_over_a_games_scenes_and_the_worst_plane_is_the_worst_of_any_game() -> None:
    rows = [
        row("a/one area", "bicubic", 30, 40, 40),
        row("a/two area", "bicubic", 32, 40, 40),
        row("b/one area", "bicubic", 20, 30, 30),
        row("a/one area", "ours", 31, 41, 42),
        row("a/two area", "ours", 34, 41, 42),
        row("b/one area", "ours", 20.25, 30, 29.5),
    ]
    gains = gains_over_bicubic(rows)["area"]
    assert gains["ours"].psnr_y_db == {"a": 1.5, "b": 0.25} and gains["ours"].mean_db == 0.875
    assert gains["ours"].worst_plane_db == -0.5 and gains["ours"].vmaf_neg == 70
    assert gains["bicubic"].mean_db == gains["bicubic"].worst_plane_db == 0 and gains["bicubic"].vmaf_neg is None


@pytest.fixture
def footage(make_clip: Callable[..., Path], tmp_path: Path) -> Path:
    clip = make_clip("clip.mkv", width=96, height=72, frames=6)
    list_of_scenes = tmp_path / "footage.toml"
    list_of_scenes.write_text(f'[[scene]]\nname = "one"\ngame = "made"\nsplit = "test"\nfps = 30\nreference = "{clip.name}"\n')
    return list_of_scenes


def test_the_command_measures_draws_and_keeps_its_rows(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows, svg = tmp_path / "rows.jsonl", tmp_path / "frontier.svg"
    command = [str(footage), "--models", "lanczos", "--degradations", "area", "--frames", "4", "--timed-frames", "1", "--rounds", "1"]
    command += ["--threads", "1", "--rows", str(rows), "--cache", str(tmp_path / "cache"), "--svg", str(svg)]
    assert main([*command, "--json"]) == 0
    candidates = {record["model"]: record for record in map(json.loads, capsys.readouterr().out.splitlines())}
    measured = {record["model"]: record for record in map(json.loads, rows.read_text().splitlines())}
    assert set(candidates) == set(measured) == {"bicubic", "lanczos"}
    gain = measured["lanczos"]["psnr_y_db"] - measured["bicubic"]["psnr_y_db"]
    assert candidates["lanczos"]["gains"]["area"]["psnr_y_db"] == {"made": pytest.approx(gain)} and gain != 0
    assert candidates["lanczos"]["p95_ms"] >= candidates["lanczos"]["p50_ms"] > 0
    assert any(candidate["gains"]["area"]["on_frontier"] for candidate in candidates.values())
    words = "".join(ElementTree.fromstring(svg.read_bytes()).itertext())
    assert "PSNR-Y over bicubic" in words and "lanczos" in words
    before = rows.read_text()
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert rows.read_text() == before and printed.count("| lanczos |") + printed.count("| **lanczos** |") == 1


def test_what_cannot_be_done_is_said_in_a_sentence(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "missing.toml")]) == 1
    assert main([str(footage), "--models", "no-such-model"]) == 1
    assert [line.startswith(f"{PROGRAM}: ") for line in capsys.readouterr().err.splitlines()] == [True, True]
