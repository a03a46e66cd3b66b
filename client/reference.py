"""Upscaled pictures against the high-resolution original, frame i with frame i."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from client.errors import InputError
from client.frames import Frame
from client.quality import Quality, QualityMeter
from client.video import VideoSource
from client.whole_frames import whole_frames


class Reference:
    """Measures several upscalers' pictures against one file as they come; a context manager.

    Raises InputError when the file cannot be read, is damaged, or is not `width` x `height` throughout.
    """

    def __init__(self, path: Path, width: int, height: int, names: Sequence[str]) -> None:
        self.notes: list[str] = []
        self._measured = 0
        self._missing = 0
        with ExitStack() as stack:
            self._source = stack.enter_context(VideoSource(path))
            if (self._source.width, self._source.height) != (width, height):
                raise InputError(
                    f"reference {path} is {self._source.width}x{self._source.height}, but the upscaled picture is {width}x{height}"
                )
            self._meters = {name: stack.enter_context(QualityMeter(width, height)) for name in names}
            self._frames = whole_frames(self._source)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.close()

    def add(self, pictures: Mapping[str, Frame]) -> None:
        """Measure the next frame's pictures, by name; beyond the end of the reference they are only counted."""
        reference = next(self._frames, None)
        if reference is None:
            self._missing += 1
            return
        for name, meter in self._meters.items():
            meter.add(reference, pictures[name])
        self._measured += 1

    def result(self) -> dict[str, Quality]:
        """The figures by name; ends the measurement. `notes` then says where the lengths differ."""
        if self._missing:
            self.notes.append(f"the reference ends after {self._measured} frames: the last {self._missing} were not measured")
        elif next(self._frames, None) is not None:
            self.notes.append(f"the reference is longer than the {self._measured} frames that were measured")
        return {name: meter.result() for name, meter in self._meters.items()}
