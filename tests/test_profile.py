"""gamesr-profile: the operations of a model whose graph is known, on each runtime, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from client.profile import PROGRAM, Part, main, profile, table


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_every_operation_is_counted_once_a_frame(model_file: Callable[..., Path], provider: str) -> None:
    """The tiny model has six resizes, of which every runtime makes at least those of the outputs, and memory that is averaged."""
    spec, parts = profile(model_file(stateful=True), provider, 1, 3)
    assert spec.name == "tiny" and len({(part.name, part.operation) for part in parts}) == len(parts) >= 5
    kinds = " ".join(part.operation for part in parts)
    assert "Resize" in kinds or "Interpolate" in kinds
    assert "Pool" in kinds and all(part.us >= 0 for part in parts)


def test_the_table_adds_up() -> None:
    parts = [Part("a", "Conv", 600.0), Part("b", "Conv", 395.0), Part("c", "Add", 3.0), Part("d", "Add", 2.0)]
    assert table(parts).splitlines()[2:] == [
        "| a | Conv | 600 | 60.0% |",
        "| b | Conv | 395 | 39.5% |",
        "| 2 more |  | 5 | 0.5% |",
        "| all |  | 1000 | 100.0% |",
    ]


def test_the_command_prints_a_table_or_lines(model_file: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    command = ["--model", str(model_file(stateful=True)), "--threads", "1", "--frames", "1"]
    assert main(command) == 0
    assert capsys.readouterr().out.startswith("tiny x2 on cpu, threads 1\n\n| operation | kind |")
    assert main([*command, "--json"]) == 0
    assert all(set(json.loads(line)) == {"name", "operation", "us"} for line in capsys.readouterr().out.splitlines())


def test_what_is_no_model_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.onnx").write_text("text")
    assert main(["--model", str(tmp_path / "text.onnx")]) == 1
    assert capsys.readouterr().err.startswith(f"{PROGRAM}: ")
