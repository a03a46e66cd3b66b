"""The models that ship, as the service shows them: what each artifact says of itself, and its card."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from client.models import shipped_models
from client.upscaler import OnnxUpscaler
from server.requests import Artifact


@cache
def artifacts() -> tuple[Artifact, ...]:
    """Read once: a shipped file stays what it is for as long as the service runs."""
    return tuple(_artifact(path) for path in shipped_models())


def model_path(name: str, scale: int) -> Path | None:
    """The shipped artifact of that name and scale; no path is made of the name."""
    return next((path for path in shipped_models() if path.stem == f"{name}_x{scale}"), None)


def _artifact(path: Path) -> Artifact:
    spec = OnnxUpscaler(path, threads=1).spec
    card = path.with_suffix(".md")
    return Artifact(
        name=path.stem.removesuffix(f"_x{spec.scale}"),
        scale=spec.scale,
        precision=spec.precision,
        size_multiple=spec.size_multiple,
        size_bytes=path.stat().st_size,
        sha256=spec.sha256,
        recurrent=bool(spec.state),
        card=spec.card,
        card_markdown=card.read_text() if card.is_file() else None,
    )
