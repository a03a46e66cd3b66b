"""The packages import one way: model -> client <- server, and the client needs nothing but its runtime."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FORBIDDEN = {
    "client": {"torch", "onnx", "onnxscript", "tqdm", "scipy", "skimage", "model", "server", "tests"},
    "model": {"server", "tests"},
}


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_imports_go_one_way(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            tops = {name.split(".")[0] for name in names}
            assert not tops & FORBIDDEN[package], f"{file.name} imports {tops & FORBIDDEN[package]}"


def test_the_client_imports_only_its_runtime() -> None:
    allowed = set(sys.stdlib_module_names) | {"numpy", "av", "onnxruntime", "imageio_ffmpeg", "client"}
    for file in (ROOT / "client").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            assert {name.split(".")[0] for name in names} <= allowed, file.name
