"""gamesr-frontier: what is on it, gains over bicubic by hand, and the command on a small clip."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client.measurement import Task
from client.runtime import PROVIDERS
from client.timing import LatencySummary
from client.upscaler import OnnxUpscaler
from model.frontier import PROGRAM, Candidate, Gains, drawing, frontier, gains_over_bicubic, main

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


def row(clip: str, model: str, y: float, u: float, v: float, provider: str = "cpu") -> dict[str, Any]:
    vmaf_neg = 70.0 if model == "ours" else None
    return {"clip": clip, "model": model, "provider": provider, "psnr_y_db": y, "psnr_u_db": u, "psnr_v_db": v, "vmaf_neg": vmaf_neg}


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
    ours, bicubic = gains["cpu", "ours"], gains["cpu", "bicubic"]
    assert ours.psnr_y_db == {"a": 1.5, "b": 0.25} and ours.mean_db == 0.875
    assert ours.worst_plane_db == -0.5 and ours.vmaf_neg == 70
    assert bicubic.mean_db == bicubic.worst_plane_db == 0 and bicubic.vmaf_neg is None


def test_gains_on_every_runtime_are_over_bicubic_on_the_processor() -> None:
    """A runtime that damages bicubic itself gets no zero of its own, and damage of both does not cancel."""
    rows = [
        row("a/one area", "bicubic", 30, 40, 40),
        row("a/one area", "bicubic", 29.75, 39.5, 40, "openvino-bfloat16"),
        row("a/one area", "ours", 31, 39.75, 41, "openvino-bfloat16"),
    ]
    gains = gains_over_bicubic(rows)["area"]
    bicubic, ours = gains["openvino-bfloat16", "bicubic"], gains["openvino-bfloat16", "ours"]
    assert (bicubic.mean_db, bicubic.worst_plane_db) == (-0.25, -0.5)
    assert (ours.mean_db, ours.worst_plane_db) == (1, -0.25)


@pytest.fixture
def footage(make_clip: Callable[..., Path], tmp_path: Path) -> Path:
    clip = make_clip("clip.mkv", width=96, height=72, frames=6)
    list_of_scenes = tmp_path / "footage.toml"
    list_of_scenes.write_text(f'[[scene]]\nname = "one"\ngame = "made"\nsplit = "test"\nfps = 30\nreference = "{clip.name}"\n')
    return list_of_scenes


def test_the_command_measures_draws_and_keeps_its_rows(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows, svg = tmp_path / "rows.jsonl", tmp_path / "frontier.svg"
    command = [str(footage), "--models", "lanczos", "--degradations", "area", "--frames", "4", "--timed-frames", "20", "--rounds", "1"]
    command += ["--threads", "1", "--rows", str(rows), "--cache", str(tmp_path / "cache"), "--svg", str(svg)]
    assert main([*command, "--json"]) == 0
    candidates = {record["model"]: record for record in map(json.loads, capsys.readouterr().out.splitlines())}
    measured = {record["model"]: record for record in map(json.loads, rows.read_text().splitlines())}
    assert set(candidates) == set(measured) == {"bicubic", "lanczos"}
    gain = measured["lanczos"]["psnr_y_db"] - measured["bicubic"]["psnr_y_db"]
    assert candidates["lanczos"]["gains"]["area"]["psnr_y_db"] == {"made": pytest.approx(gain)} and gain != 0
    assert candidates["lanczos"]["p95_ms"] >= candidates["lanczos"]["p50_ms"] > 0
    worse, better = sorted(candidates.values(), key=lambda candidate: candidate["gains"]["area"]["psnr_y_db"]["made"])
    assert better["gains"]["area"]["on_frontier"] is True
    assert worse["gains"]["area"]["on_frontier"] is (worse["p95_ms"] < better["p95_ms"])
    words = "".join(ElementTree.fromstring(svg.read_bytes()).itertext())
    assert "PSNR-Y over bicubic" in words and "lanczos" in words
    before = rows.read_text()
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert rows.read_text() == before and printed.count("| lanczos |") + printed.count("| **lanczos** |") == 1


@pytest.fixture
def taking(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Milliseconds of a frame by model, in place of runs that are timed."""
    milliseconds: dict[str, float] = {}

    def run(task: Task) -> SimpleNamespace:
        spec = OnnxUpscaler(task.model, threads=1).spec
        ms = milliseconds[spec.name]
        return SimpleNamespace(spec=spec, latency_us={"upscale": SimpleNamespace(p50=1000 * ms, p95=1000 * ms)})

    monkeypatch.setattr("model.frontier.measure_in_fresh_process", run)
    return milliseconds


@pytest.mark.parametrize("slower_ms", [2.0, 4.0])
def test_of_what_is_no_faster_the_best_is_on_the_frontier_and_bold(
    footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], taking: dict[str, float], slower_ms: float
) -> None:
    taking.update(bicubic=3.0, lanczos=slower_ms)
    command = [str(footage), "--models", "lanczos", "--degradations", "area", "--frames", "4", "--threads", "1"]
    command += ["--rows", str(tmp_path / "rows.jsonl"), "--cache", str(tmp_path / "cache")]
    assert main([*command, "--json"]) == 0
    candidates = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    points = {c["model"]: (c["p95_ms"], c["gains"]["area"]["psnr_y_db"]["made"]) for c in candidates}
    (fast_ms, fast_db), (_, slow_db) = sorted(points.values())
    expected = {model for model, (ms, _) in points.items() if ms == fast_ms or slow_db > fast_db}
    assert {c["model"] for c in candidates if c["gains"]["area"]["on_frontier"]} == expected and slow_db != fast_db
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert {model for model in points if f"| **{model}** |" in printed} == expected


def test_the_yardstick_is_measured_on_the_processor_whatever_is_asked_for(
    footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], taking: dict[str, float]
) -> None:
    taking.update(bicubic=1.0, lanczos=2.0)
    rows = tmp_path / "rows.jsonl"
    command = [str(footage), "--models", "lanczos", "--providers", "openvino", "--degradations", "area", "--frames", "2", "--json"]
    assert main([*command, "--threads", "1", "--rows", str(rows), "--cache", str(tmp_path / "cache")]) == 0
    measured = {(record["model"], record["provider"]): record["psnr_y_db"] for record in map(json.loads, rows.read_text().splitlines())}
    assert set(measured) == {("bicubic", "cpu"), ("bicubic", "openvino"), ("lanczos", "openvino")}
    for candidate in map(json.loads, capsys.readouterr().out.splitlines()):
        gain = measured[candidate["model"], candidate["provider"]] - measured["bicubic", "cpu"]
        assert candidate["provider"] == "openvino" and candidate["gains"]["area"]["psnr_y_db"]["made"] == pytest.approx(gain)


def test_a_p95_of_too_few_frames_is_refused(footage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    durations_ns = list(range(1, 21))
    assert LatencySummary.of(durations_ns).p95 < LatencySummary.of(durations_ns).max
    assert LatencySummary.of(durations_ns[:-1]).p95 == LatencySummary.of(durations_ns[:-1]).max
    with pytest.raises(SystemExit) as exit_:
        main([str(footage), "--timed-frames", "19"])
    assert exit_.value.code == 2 and "the p95 of 19 frames is their slowest: time 20 or more" in capsys.readouterr().err


def test_two_models_of_one_name_are_refused(
    footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], model_file: Callable[..., Path], taking: dict[str, float]
) -> None:
    taking.update(bicubic=1.0, tiny=1.0)
    one, other = model_file("one.onnx"), model_file("other.onnx", gain=0.25)
    command = [str(footage), "--models", str(one), str(other), "--degradations", "area", "--frames", "1"]
    assert main([*command, "--rows", str(tmp_path / "rows.jsonl"), "--cache", str(tmp_path / "cache")]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"{PROGRAM}: {one} and {other} are different models of one name, 'tiny'") and said.count("\n") == 1


def test_no_scene_that_was_rendered_for_it_is_said_before_anything_is_timed(
    footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("model.frontier.measure_in_fresh_process", lambda task: pytest.fail("it was timed"))
    command = [str(footage), "--degradations", "native", "native:aa", "--rows", str(tmp_path / "rows"), "--cache", str(tmp_path / "cache")]
    assert main(command) == 1
    assert capsys.readouterr().err == f"{PROGRAM}: no scene of {footage} was rendered for native or native:aa\n"


def test_a_drawing_that_cannot_be_written_is_said_first_and_costs_no_table(
    footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], taking: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    taking.update(bicubic=1.0)
    command = [str(footage), "--models", "bicubic", "--degradations", "area", "--frames", "2", "--threads", "1"]
    command += ["--rows", str(tmp_path / "rows.jsonl"), "--cache", str(tmp_path / "cache")]
    assert main([*command, "--svg", str(tmp_path / "nowhere" / "frontier.svg")]) == 1
    assert capsys.readouterr().err == f"{PROGRAM}: {tmp_path / 'nowhere'} is not a folder: make it, or name another with --svg\n"
    assert not (tmp_path / "rows.jsonl").exists()
    (tmp_path / "folder.svg").mkdir()
    assert main([*command, "--svg", str(tmp_path / "folder.svg")]) == 1
    said = capsys.readouterr()
    assert "| **bicubic** |" in said.out and "cannot write" in said.err


def test_every_runtime_has_a_marker() -> None:
    candidates = [
        Candidate("ours", provider, None, None, ms, ms, {"area": Gains({"a": 1.0 * ms}, 0, None, True)})
        for ms, provider in enumerate(PROVIDERS, 1)
    ]
    words = "".join(ElementTree.fromstring(drawing(candidates)).itertext())
    assert all(provider in words for provider in PROVIDERS)


def test_what_is_not_measured_is_said(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], taking: dict[str, float]) -> None:
    taking.update(bicubic=1.0)
    command = [str(footage), "--models", "bicubic", "--degradations", "area", "native", "--frames", "8", "--threads", "1"]
    assert main([*command, "--rows", str(tmp_path / "rows.jsonl"), "--cache", str(tmp_path / "cache"), "--json"]) == 0
    assert capsys.readouterr().err.splitlines() == [
        f"{PROGRAM}: made/one has 6 frames only, of the 8 that were asked for",
        f"{PROGRAM}: made/one was left out of native, for which it was not rendered",
    ]


def test_what_cannot_be_done_is_said_in_a_sentence(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "missing.toml")]) == 1
    assert main([str(footage), "--models", "no-such-model"]) == 1
    assert [line.startswith(f"{PROGRAM}: ") for line in capsys.readouterr().err.splitlines()] == [True, True]
