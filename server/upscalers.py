"""The upscalers of a sweep: which artifact each name means at each scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from client.artifact import ModelSpec
from client.errors import InputError, ModelError
from client.models import find_model, shipped_models
from client.upscaler import OnnxUpscaler
from server.clips import PARTS, SCALES
from server.names import shown
from server.points import NO_UPSCALER


@dataclass(frozen=True)
class Artifact:
    """An artifact by its file, known by the sha256 of its content."""

    path: Path
    sha256: str


class Upscalers:
    """The artifacts that were asked for, by scale; scale 1 has `none` only, for which there is no artifact.

    Raises ModelError for a name that nothing is known by, a file that is no artifact, and what is asked for twice.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._by_scale: dict[int, dict[str, Artifact | None]] = {1: {}, **{scale: {} for scale in SCALES}}
        self._used: set[str] = set()
        for name in dict.fromkeys(names):
            if name == NO_UPSCALER:
                self._by_scale[1][name] = None
                continue
            called = shown(Path(name).stem) if Path(name).suffix == ".onnx" else name
            for path, spec in _artifacts(name):
                of_scale = self._by_scale[spec.scale]
                for other, artifact in of_scale.items():
                    if other == called or (artifact and artifact.sha256 == spec.sha256):
                        raise ModelError(f"upscaler {name} is asked for twice, or another one of its name or content is: name it once")
                of_scale[called] = Artifact(path, spec.sha256)

    def at(self, scale: int) -> Mapping[str, Artifact | None]:
        """By name, in the order in which they were asked for; what is taken here counts as used."""
        self._used.update(self._by_scale[scale])
        return self._by_scale[scale]

    def check_all_used(self) -> None:
        """Raises InputError for an upscaler that no clip and height had a use for."""
        scales: dict[str, list[str]] = {}
        for scale, models in self._by_scale.items():
            for name in models:
                scales.setdefault(name, []).append(PARTS[scale])
        for name, parts in scales.items():
            if name not in self._used:
                part = " or ".join(f"a {part}" for part in parts)
                raise InputError(
                    f"upscaler {name} needs a height that is {part} of a clip's, an even number of pixels each way: see --heights"
                )


def _artifacts(name: str) -> list[tuple[Path, ModelSpec]]:
    """A file, or a shipped model at every scale that it has."""
    shipped = {path.name for path in shipped_models()}
    scales = [scale for scale in SCALES if f"{name}_x{scale}.onnx" in shipped] or [SCALES[0]]
    paths = [find_model(name, scale) for scale in scales]
    return [(path, OnnxUpscaler(path, threads=1).spec) for path in paths]
