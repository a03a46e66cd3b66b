"""Where a new artifact and its page go, looked at before any work is done; and how they get there, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import onnx

from client.artifact import MAX_WORD, is_short_word
from client.errors import OutputError

Page = Callable[[str, int, dict[str, Any]], str]  # of a name, a scale and a card: Markdown


def new_artifacts(name: str, scales: Sequence[int], folder: Path, *, source: Path, force: bool) -> list[Path]:
    """The artifact of model `name` at each scale; its page lies beside it as .md.

    Raises OutputError for a name by which the client would not find it or read it, for a folder that is not there, for a file that is
    there, unless `force` replaces it, and in any case where that is no file, or `source`, which the artifact is made of.
    """
    if not is_short_word(name) or any(separator in name for separator in "/\\") or name.endswith(".onnx"):
        rule = f"use up to {MAX_WORD} printable ASCII characters, no / or \\ and no .onnx"
        raise OutputError(f"{name!r} cannot be a model's name: {rule}")
    if not folder.is_dir():
        raise OutputError(f"{folder} is not a folder: make it, or name another with --folder")
    paths = [folder / f"{name}_x{scale}.onnx" for scale in scales]
    for file in (file for path in paths for file in (path, path.with_suffix(".md")) if file.exists()):
        if source.exists() and file.samefile(source):
            raise OutputError(f"cannot write {file}: it is the input, so choose another name")
        if not file.is_file():
            raise OutputError(f"cannot write {file}: it is not a file")
        if not force:
            raise OutputError(f"{file} exists: choose another name, or replace it with --force")
    return paths


def write_artifact(model: onnx.ModelProto, path: Path, page: str | None) -> None:
    """Write an artifact and its page, neither of which is seen before both are written; without a page none stays beside it."""
    beside = path.with_suffix(".md")
    partial, partial_page = (file.with_name(f"{file.name}.{os.getpid()}.partial") for file in (path, beside))
    try:
        onnx.save(model, str(partial))
        if page is not None:
            partial_page.write_text(page)
        partial.replace(path)
        if page is None:
            beside.unlink(missing_ok=True)
        else:
            partial_page.replace(beside)
    finally:
        partial.unlink(missing_ok=True)
        partial_page.unlink(missing_ok=True)
