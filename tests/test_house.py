"""The packages import one way: model -> client <- server, each needs nothing but its own, and no file is long."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MOST_LINES = 320  # about 300 is what is wanted
RUNTIME = {"numpy", "av", "onnxruntime", "imageio_ffmpeg", "aiortc", "sdl2"}
WORKSHOP = {"torch", "onnx", "tqdm", "matplotlib"}
HARNESS = {"distributed", "bjontegaard", "matplotlib"}
SERVICE = {"fastapi", "starlette", "pydantic", "uvicorn", "prometheus_client", "anyio"}


def imported(package: str) -> dict[str, set[str]]:
    """The top-level names that each file of a package imports, anywhere in it."""
    found = {}
    for file in sorted((ROOT / package).rglob("*.py")):
        names: list[str] = []
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names.append(node.module or "")
        found[str(file.relative_to(ROOT))] = {name.split(".")[0] for name in names}
    return found


@pytest.mark.parametrize(
    ("package", "allowed"),
    [
        ("client", {"client"} | RUNTIME),
        ("model", {"client", "model"} | RUNTIME | WORKSHOP),
        ("server", {"client", "server"} | RUNTIME | HARNESS | SERVICE),
    ],
)
def test_imports_go_one_way(package: str, allowed: set[str]) -> None:
    files = imported(package)
    assert len(files) > 5
    for file, names in files.items():
        assert names <= allowed | set(sys.stdlib_module_names), file


@pytest.mark.parametrize("folder", ["client", "model", "server", "tests"])
def test_no_file_is_long(folder: str) -> None:
    lines = {str(file.relative_to(ROOT)): len(file.read_text().splitlines()) for file in sorted((ROOT / folder).rglob("*.py"))}
    assert len(lines) > 5
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}
