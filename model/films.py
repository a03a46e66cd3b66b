"""A film of a footage list: what it is, before all of it is decoded, and its frames."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from client.errors import InputError
from client.frames import ColourTags, Frame
from client.quality import may_be_of_one_coding
from client.video import VideoSource
from client.whole_frames import whole_frames

RATE_TOLERANCE = 0.01


@dataclass(frozen=True)
class Film:
    """A video file with its content's digest, the number of its packets, each a frame, and the colour tags of the first frame."""

    path: Path
    digest: str
    length: int
    width: int
    height: int
    colour: ColourTags

    @classmethod
    def of(cls, path: Path, fps: int) -> Self:
        """Raises InputError for a file that is no film, has an odd side or, as far as it tells its frame rate, not `fps`."""
        digest = _digest(path)
        with VideoSource(path) as source:
            if source.width % 2 or source.height % 2:
                raise InputError(f"{path} is {source.width}x{source.height}, and H.264 needs even sides: crop it first")
            told = source.estimated_frames is not None  # a stream that tells no times has a rate that is made up
            if told and abs(source.frame_rate / fps - 1) > RATE_TOLERANCE:
                raise InputError(f"{path} has {float(source.frame_rate):.6g} frames a second, where its list says fps = {fps}")
            colour, length = None, 0
            for packet in source.packets():
                length += packet.size > 0  # the last one only flushes
                if colour is None:
                    colour = next((decoded.frame.colour for decoded in source.decode(packet)), None)
            if colour is None:
                raise InputError(f"no frame of {path} could be decoded")
            return cls(path, digest, length, source.width, source.height, colour)

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"

    def frames(self) -> Iterator[Frame]:
        """Every frame; raises InputError at the first that is damaged or of another size."""
        with VideoSource(self.path) as source:
            yield from whole_frames(source)

    def check_scale(self, scale: int) -> None:
        """Raises InputError where 1/scale of the picture has no even sides."""
        if self.width % (2 * scale) or self.height % (2 * scale):
            raise InputError(
                f"{self.path} is {self.size}, which cannot be reduced by {scale} to even sides: leave that scale out, or crop the film"
            )

    def check_render(self, render: Film, scale: int) -> None:
        """Raises InputError where `render` cannot be 1/scale of this film: by its size, its length, or what colours its codes are."""
        if (scale * render.width, scale * render.height) != (self.width, self.height):
            raise InputError(f"{render.path} is {render.size}, which is not 1/{scale} of {self.path} with its {self.size}")
        if render.length != self.length:
            raise InputError(f"{render.path} has {render.length} frames and {self.path} {self.length}: one of them is cut short")
        if not may_be_of_one_coding(render.colour, self.colour):
            ours, theirs = render.colour, self.colour
            raise InputError(
                f"{render.path} (range {ours.range}, matrix {ours.matrix}) is not of one colour coding with {self.path} "
                f"(range {theirs.range}, matrix {theirs.matrix}): convert one of them"
            )


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
