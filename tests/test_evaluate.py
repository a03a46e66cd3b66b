"""gamesr-evaluate: when a row is measured anew, what is refused before any measuring, and what is said to be missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client.models import find_model
from model import evaluate
from model.cli import evaluate_main
from tests.moving import scene, write_footage


@pytest.fixture
def command(tmp_path: Path) -> list[str]:
    """Bicubic by 2 on the one test scene, of 12 frames, averaged down."""
    options = {"cache": tmp_path / "cache", "rows": tmp_path / "rows.jsonl", "models": "bicubic", "degradations": "area"}
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return [str(write_footage(tmp_path)), *words, "--scales", "2", "--frames", "2"]


def rows(command: list[str]) -> list[dict[str, object]]:
    return [json.loads(line) for line in Path(command[command.index("--rows") + 1]).read_text().splitlines()]


@pytest.mark.parametrize(
    ("what", "name", "value"),
    [
        ("model.evaluate._code", "gamesr", lambda: "other"),
        ("av.__version__", "av", "other"),
        ("model.evaluate.machine_name", "machine", lambda: "other"),
    ],
)
def test_a_row_of_other_code_or_another_machine_is_measured_again(
    command: list[str], monkeypatch: pytest.MonkeyPatch, what: str, name: str, value: object
) -> None:
    assert evaluate_main(command) == 0
    monkeypatch.setattr(what, value)
    for _ in range(2):
        assert evaluate_main(command) == 0
    before, after = (row["versions"] for row in rows(command))
    assert isinstance(before, dict) and after == before | {name: "other"} != before


def test_the_code_of_a_row_is_all_of_the_clients_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate, "WEIGHTS", tmp_path / "weights")
    found = set()
    for content in ("a = 1\n", "a = 2\n"):
        (tmp_path / "upscaler.py").write_text(content)
        evaluate._code.cache_clear()
        found.add(evaluate._code())
    evaluate._code.cache_clear()
    assert len(found) == 2


def test_no_more_frames_are_decoded_than_are_measured(command: list[str], tmp_path: Path) -> None:
    assert evaluate_main([*command, "--degradations", "area", "area@300"]) == 0
    assert [row["frames"] for row in rows(command)] == [2, 2]
    assert [len(np.load(take)) for take in (tmp_path / "cache").iterdir()] == [2, 2, 2]


def test_a_film_of_another_size_is_refused_before_any_measuring(
    command: list[str], make_clip: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_clip("wide.mkv", width=128, height=72)
    with (tmp_path / "footage.toml").open("a") as footage:
        footage.write(scene("wide", "a", "test", "wide.mkv"))
    assert evaluate_main([*command, "--scales", "2", "3"]) == 1
    assert capsys.readouterr().err == (
        f"gamesr-evaluate: {tmp_path / 'wide.mkv'} is 128x72, which cannot be reduced by 3 to even sides: "
        "leave that scale out, or crop the film\n"
    )
    assert not (tmp_path / "rows.jsonl").exists() and not list((tmp_path / "cache").iterdir())
    assert evaluate_main(command) == 0


def test_an_artifact_of_another_scale_is_refused_before_any_measuring(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    artifact = find_model("lanczos", 2)
    assert evaluate_main([*command, "--models", "bicubic", str(artifact), "--scales", "2", "3"]) == 1
    said = capsys.readouterr().err
    assert said == f"gamesr-evaluate: {artifact} upscales by 2 and not by 3: measure it at its own scale alone\n"
    assert not (tmp_path / "rows.jsonl").exists()


def test_what_is_not_measured_is_said(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate_main([*command, "--frames", "12", "--json"]) == 0
    assert capsys.readouterr().err == ""
    assert evaluate_main([*command, "--frames", "60", "--degradations", "area", "native", "native:aa@100"]) == 0
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        "gamesr-evaluate: a/five has 12 frames only, of the 60 that were asked for",
        "gamesr-evaluate: a/five was left out of native, for which it was not rendered",
        "gamesr-evaluate: a/five was left out of native:aa@100, for which it was not rendered",
    ]
    assert said.out.count("| bicubic |") == 1
