"""Every command that is installed explains itself."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path

import pytest

COMMANDS: dict[str, str] = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_says_how_to_use_it(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    module, function = COMMANDS[command].split(":")
    with pytest.raises(SystemExit) as exit_:
        getattr(importlib.import_module(module), function)(["--help"])
    said = capsys.readouterr().out
    assert exit_.value.code == 0 and said.startswith(f"usage: {command}") and "--help" in said
    assert "example" in said


@pytest.mark.parametrize("command", COMMANDS)
def test_it_says_its_version(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    module, function = COMMANDS[command].split(":")
    with pytest.raises(SystemExit) as exit_:
        getattr(importlib.import_module(module), function)(["--version"])
    assert exit_.value.code == 0 and capsys.readouterr().out.startswith(f"{command}, of GameSR ")
