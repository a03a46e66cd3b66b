"""The trained artifacts that ship with the client, found by name."""

from __future__ import annotations

from pathlib import Path

from client.errors import ModelError

DEFAULT_MODEL = "gamesr"
WEIGHTS = Path(__file__).parent / "weights"


def shipped_models() -> list[Path]:
    """Every shipped artifact, sorted; the file of model NAME at scale S is NAME_xS.onnx."""
    return sorted(WEIGHTS.glob("*_x[23].onnx"))


def find_model(name: str, scale: int) -> Path:
    """The artifact that `name` means: a file if it looks like one (a separator or .onnx in it), else a shipped model.

    A shipped model's name may say its scale, NAME_x3; else it is the one for `scale`. Raises ModelError, naming what there is, when no such
    model ships; whether a file is there shows when it is read.
    """
    given = Path(name)
    if given.suffix == ".onnx" or len(given.parts) > 1:
        return given
    models = {path.stem: path for path in shipped_models()}
    for stem in (f"{name}_x{scale}", name):
        if stem in models:
            return models[stem]
    there = ", ".join(stem.removesuffix(f"_x{scale}") for stem in models if stem.endswith(f"_x{scale}")) or "none"
    hint = f"{name} is a file, but no .onnx" if given.is_file() else "a file is named by its path"
    raise ModelError(f"no model named {name!r} ships for scale {scale} (there is {there}); {hint}")
