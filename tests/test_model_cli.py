"""The workshop's commands one after the other, as their user runs them: train, export, verify, evaluate."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from client.models import find_model
from client.upscaler import OnnxUpscaler
from model.cli import evaluate_main, train_main, verify_main
from model.export_cli import main as export_main
from model.verify import PARITY_HEADER, StepError
from tests.moving import write_footage

TINY = ["--steps", "4", "--batch", "2", "--patch", "16", "--frames", "4", "--window", "2", "--degradations", "area"]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("workshop")
    footage = write_footage(folder)
    assert train_main([str(footage), str(folder / "run"), "--cache", str(folder / "cache"), "--learning-rate", "0.002", *TINY]) == 0
    assert export_main([str(folder / "run" / "checkpoint.pt"), "tiny", "--folder", str(folder)]) == 0
    return folder


def test_the_artifact_and_its_card_say_how_it_was_made(workshop: Path) -> None:
    card = OnnxUpscaler(workshop / "tiny_x2.onnx", threads=1).spec.card
    assert card["command"] == (
        "gamesr-train FOOTAGE.toml RUN --degradations area --steps 4 --batch 2 --patch 16 --frames 4 --window 2 --learning-rate 0.002"
    )
    assert card["steps"] == 4
    assert card["footage"]["train"] == ["a/one (12 frames)", "b/two (12 frames)", "b/three (12 frames)"]
    page = (workshop / "tiny_x2.md").read_text()
    assert card["command"] in page
    assert "| a/four area | " in page
    assert (card["parameters"], card["macs_540p"]) == (130_812, 16_880_140_800)
    assert "130,812 parameters (290,172 in training), float32; 16.88 GMAC for a frame of 960x540." in page


def test_a_card_names_the_runs_that_a_run_was_built_on(workshop: Path) -> None:
    again = ["--cache", str(workshop / "cache"), "--initial-weights", str(workshop / "run" / "checkpoint.pt"), *TINY]
    assert train_main([str(workshop / "footage.toml"), str(workshop / "further"), *again]) == 0
    assert export_main([str(workshop / "further" / "checkpoint.pt"), "further", "--folder", str(workshop)]) == 0
    page = (workshop / "further_x2.md").read_text()
    assert "- Built on: `gamesr-train FOOTAGE.toml RUN --degradations area --steps 4 " in page
    assert "--initial-weights run/checkpoint.pt`" in page
    assert str(workshop) not in page


def test_a_card_says_what_the_weights_were_averaged_with(workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    into, run, tiny = ["--folder", str(tmp_path)], str(workshop / "run" / "checkpoint.pt"), workshop / "tiny_x2.onnx"
    assert export_main([run, "between", *into, "--average", str(tiny), "0.25"]) == 0
    spec = OnnxUpscaler(tiny, threads=1).spec
    assert OnnxUpscaler(tmp_path / "between_x2.onnx", threads=1).spec.card["averaged"] == {"with": spec.sha256, "share": 0.25}
    page = (tmp_path / "between_x2.md").read_text()
    assert f"- Averaged: 25% of the weights are those of the artifact {spec.sha256} (SHA-256)" in page
    assert "PSNR-Y in dB, before it was averaged:" in page
    capsys.readouterr()
    for average, sentence in (
        ((run, tiny, "a fifth"), "a share from 0 to 1, not 'a fifth'"),
        ((run, tiny, "1"), "it lies between 0 and 1"),
        ((run, find_model("live", 2), "0.5"), "is another network than the checkpoint's"),
        (("bicubic", tiny, "0.5"), "bicubic has no weights to be averaged"),
    ):
        weights, artifact, share = average
        assert export_main([str(weights), "other", *into, "--average", str(artifact), share]) == 1
        assert sentence in capsys.readouterr().err
    assert not list(tmp_path.glob("other*"))


def test_a_baseline_has_the_name_that_it_is_given_and_no_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (pages := [tmp_path / f"plain_x{scale}.md" for scale in (2, 3)]):
        path.write_text("of a network that was here before")
    assert export_main(["lanczos", "plain", "--folder", str(tmp_path), "--force"]) == 0
    assert capsys.readouterr().out.splitlines() == [str(path.with_suffix(".onnx")) for path in pages]
    assert {path.name for path in tmp_path.iterdir()} == {"plain_x2.onnx", "plain_x3.onnx"}
    for path in pages:
        spec = OnnxUpscaler(path.with_suffix(".onnx"), threads=1).spec
        assert (f"{spec.name}_x{spec.scale}", spec.card) == (path.stem, {"interpolation": "lanczos"})


def test_verify_holds_the_artifact_against_float64(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(workshop / "tiny_x2.onnx"), str(workshop / "clip.mkv"), "--steps", "12", "--crop", "48x32"]
    assert verify_main([*command, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["step"] for row in rows] == list(range(1, 13))
    assert max(row["max_code_error"] for row in rows) <= 1
    assert verify_main([*command, "--provider", "cpu", "openvino"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "\n".join(lines[:2]) == PARITY_HEADER and len({line.count("|") for line in lines}) == 1
    shown = [tuple(line.split(" | ")[:2]) for line in lines[2:]]
    assert shown == [(f"| {frame}", provider) for frame in ("1", "10", "12", "any") for provider in ("cpu", "openvino")]
    assert verify_main([*command[:-1], "48x33"]) == 1
    assert "not a size" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("steps", "change", "sentence"),
    [
        (199, {"max_code_error": 2}, "on openvino 2 codes of picture error, at most 1 allowed"),
        (199, {"differing_pixels": 0.002}, "on openvino 0.002 of the samples differ, at most 0.001 allowed"),
        (199, {"max_state_error": 4e-4}, "on openvino 4e-05 of state error, at most 3e-05 allowed"),
        (200, {"rms_state_error": 2e-9}, "on openvino 2e-06 of drift per 1,000 frames, at most 1e-06 allowed"),
        (199, {"rms_state_error": 2e-9}, ""),
    ],
)
def test_verify_enforces_every_bound(
    workshop: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    steps: int,
    change: dict[str, float],
    sentence: str,
) -> None:
    """Of two providers one breaks a single bound; a drift of 2e-9 a frame shows in 200 frames. The largest state is 10."""

    def parity(*_: object, providers: Sequence[str], **__: object) -> Iterator[StepError]:
        for step in range(1, steps + 1):
            for provider in providers:
                sound = StepError(provider, step, 1, 0, 1e-4, None, 1e-5, 0.0, 10.0, 2304)
                slope = {name: value * step if name == "rms_state_error" else value for name, value in change.items()}
                yield sound if provider == "cpu" else replace(sound, **slope)

    monkeypatch.setattr("model.cli.parity", parity)
    model = str(workshop / "tiny_x2.onnx")
    command = [model, str(workshop / "clip.mkv"), "--crop", "48x32", "--provider", "cpu", "openvino"]
    assert verify_main(command) == (1 if sentence else 0)
    expected = f"gamesr-verify: {model} is too far from its float64 reference: {sentence}\n" if sentence else ""
    assert capsys.readouterr().err == expected


def test_evaluate_refuses_two_models_of_one_name(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export_main(["lanczos", "bicubic", "--folder", str(workshop)]) == 0
    other = workshop / "bicubic_x2.onnx"
    command = [str(workshop / "footage.toml"), "--cache", str(workshop / "cache"), "--rows", str(workshop / "names.jsonl"), "--scales", "2"]
    assert evaluate_main([*command, "--frames", "1", "--degradations", "area", "--models", "bicubic", str(other)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"gamesr-evaluate: {find_model('bicubic', 2)} and {other} are different models of one name, 'bicubic'")
    assert not (workshop / "names.jsonl").exists()


def test_evaluate_says_when_no_scene_was_rendered_for_that(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    footage = workshop / "footage.toml"
    command = [str(footage), "--cache", str(workshop / "cache"), "--rows", str(workshop / "native.jsonl"), "--scales", "2"]
    assert evaluate_main([*command, "--degradations", "native@8000", "--models", "bicubic"]) == 1
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", f"gamesr-evaluate: no scene of {footage} was rendered for native@8000\n")


def test_an_artifact_named_twice_is_measured_once(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(workshop / "footage.toml"), "--cache", str(workshop / "cache"), "--rows", str(workshop / "twice.jsonl"), "--scales", "2"]
    names = ["bicubic", str(find_model("bicubic", 2))]
    assert evaluate_main([*command, "--frames", "1", "--degradations", "area", "--json", "--models", *names]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len((workshop / "twice.jsonl").read_text().splitlines()) == 1


def test_evaluate_knows_a_row_by_its_footage_and_not_by_the_scenes_name(
    workshop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = ["--cache", str(tmp_path / "cache"), "--rows", str(tmp_path / "rows.jsonl"), "--models", "bicubic", "--scales", "2", "--json"]
    found = []
    footage = write_footage(tmp_path)
    for film in ("test.mkv", "native.mkv"):
        (tmp_path / film).replace(tmp_path / "test.mkv")
        assert evaluate_main([str(footage), "--degradations", "area", "--frames", "4", *again]) == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0]["clip"] == found[1]["clip"] and found[0]["psnr_y_db"] != found[1]["psnr_y_db"]


@pytest.fixture
def measured(workshop: Path, tmp_path: Path) -> list[str]:
    """A command that measures bicubic once, into rows.jsonl."""
    again = ["--cache", str(workshop / "cache"), "--rows", str(tmp_path / "rows.jsonl"), "--models", "bicubic", "--scales", "2"]
    command = [str(workshop / "footage.toml"), "--degradations", "area", "--frames", "2", *again]
    assert evaluate_main(command) == 0
    return command


def test_a_row_of_other_versions_is_measured_again(measured: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = tmp_path / "rows.jsonl"
    (first,) = map(json.loads, rows.read_text().splitlines())
    rows.write_text(json.dumps({name: value for name, value in first.items() if name != "versions"}) + "\n")  # as they were made once
    for module, name, value in (("onnxruntime", "__version__", "0"), ("model.evaluate", "why_unavailable", lambda *_: "no VMAF here")):
        for _ in range(2):
            assert evaluate_main(measured) == 0
        monkeypatch.setattr(f"{module}.{name}", value)
    for _ in range(2):
        assert evaluate_main([*measured, "--provider", "openvino"]) == 0
    before, second, third, fourth = map(json.loads, rows.read_text().splitlines())
    assert "versions" not in before and second == first and set(first["versions"]) == {"gamesr", "av", "onnxruntime", "machine", "vmaf"}
    assert third["versions"] == first["versions"] | {"onnxruntime": "0"}
    assert fourth["versions"]["vmaf"] == "no VMAF here" and fourth["versions"]["openvino"]


@pytest.mark.parametrize("kept", [1, 40])
def test_a_row_that_a_killed_run_left_unfinished_is_measured_again(measured: list[str], tmp_path: Path, kept: int) -> None:
    rows = tmp_path / "rows.jsonl"
    row = rows.read_bytes()
    other = row.replace(b'"provider": "cpu"', b'"provider": "elsewhere"')
    rows.write_bytes(other + row[:kept])
    assert evaluate_main(measured) == 0
    assert rows.read_bytes() == other + row


@pytest.mark.parametrize("content", [b"[1]\n", b"3\n", b"{}\n", b"\xff\n", b"[" * 100_000 + b"\n", b'{"a": 1}', b"notes"])
def test_a_file_of_something_else_is_refused_and_left_alone(
    measured: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    rows = tmp_path / "rows.jsonl"
    rows.write_bytes(content)
    capsys.readouterr()
    assert evaluate_main(measured) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"gamesr-evaluate: {rows} is not a file of rows") and said.count("\n") == 1
    assert rows.read_bytes() == content


def test_evaluate_measures_each_row_once(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [str(workshop / "footage.toml"), "--cache", str(workshop / "cache"), "--rows", str(workshop / "rows.jsonl")]
    command += [
        "--models",
        "bicubic",
        str(workshop / "tiny_x2.onnx"),
        "--scales",
        "2",
        "--degradations",
        "area",
        "area@300",
        "--frames",
        "6",
    ]
    assert evaluate_main([*command, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["clip"], row["model"]) for row in rows] == [
        ("a/five area", "bicubic"),
        ("a/five area", "tiny"),
        ("a/five area@300", "bicubic"),
        ("a/five area@300", "tiny"),
    ]
    assert rows[0]["psnr_y_db"] > rows[2]["psnr_y_db"] > 10
    assert [(row["parameters"], row["macs_540p"]) for row in rows[:2]] == [(None, None), (130_812, 16_880_140_800)]
    before = (workshop / "rows.jsonl").read_bytes()
    assert evaluate_main(command) == 0
    assert (workshop / "rows.jsonl").read_bytes() == before
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 6
    assert table[2].startswith(f"| a | x2 | area | bicubic | {rows[0]['psnr_y_db']:.2f} |")
    assert table[2].endswith(" |  |  |") and table[3].endswith(" | 130,812 | 16.9 |")
    assert len({line.count("|") for line in table}) == 1


def test_a_missing_folder_is_one_sentence(workshop: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export_main([str(workshop / "run" / "checkpoint.pt"), "tiny", "--folder", str(workshop / "nowhere")]) == 1
    assert capsys.readouterr().err.endswith("nowhere is not a folder: make it, or name another with --folder\n")


@pytest.mark.parametrize(
    ("main", "command", "sentence"),
    [
        (train_main, ["missing.toml", "run"], "cannot be read: No such file"),
        (export_main, ["missing.pt", "name"], "cannot be read: No such file"),
        (verify_main, ["missing.onnx", "missing.mp4"], "does not exist"),
        (evaluate_main, ["missing.toml"], "cannot be read: No such file"),
    ],
)
def test_what_is_not_there_is_one_sentence(
    main: object, command: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert callable(main)
    assert main(command) == 1
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
