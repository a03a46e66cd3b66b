"""The clips of a sweep: what is known of a file before any of it is decoded, and into which parts it can be brought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from client.errors import InputError
from client.video import VideoSource
from server.job import content_sha256
from server.names import shown
from server.rate import whole_rate

SCALES = (2, 3)
PARTS = {1: "whole", 2: "half", 3: "third"}


@dataclass(frozen=True)
class Clip:
    """A video file; `fps` is its rate as a whole number, `frames` how many its container announces, None where it does not."""

    path: Path
    sha256: str
    width: int
    height: int
    fps: int
    frames: int | None

    @classmethod
    def read(cls, path: Path) -> Clip:
        """Open the file and hash it; raises InputError for what cannot be read, or not at a whole and constant rate."""
        with VideoSource(path) as source:
            fps, _ = whole_rate(source)
            return cls(path, content_sha256(path), source.width, source.height, fps, source.announced_frames)

    def divides(self, scale: int) -> bool:
        """Whether that part of the picture is an even number of pixels each way, as H.264's 4:2:0 needs."""
        return self.width % (2 * scale) == 0 and self.height % (2 * scale) == 0

    def scale_to(self, height: int) -> int:
        """How many times as high the clip is; raises InputError unless that is 1, 2 or 3."""
        if height not in [self.height / scale for scale in PARTS]:
            raise InputError(f"{self.path} is {self.height} high, of which {height} is neither the whole, nor half, nor a third")
        return self.height // height

    def step_to(self, fps: int | None) -> int:
        """Every how many frames one is taken, None for the clip's own rate; raises InputError where that is no whole number."""
        if fps is None:
            return 1
        if self.fps % fps:
            raise InputError(f"{self.path} has {self.fps} frames a second, of which {fps} is no whole part: give another --fps")
        return self.fps // fps


def clip_names(clips: Sequence[Clip]) -> dict[Path, str]:
    """What clips are called: the names of their files, with their folders where two are alike."""
    stems = [clip.path.stem for clip in clips]
    by_content: dict[str, Path] = {}
    for clip in clips:
        other = by_content.setdefault(clip.sha256, clip.path)
        if other is not clip.path:
            raise InputError(f"{other} and {clip.path} are the same clip: name it once")
    return {clip.path: shown(clip.path.stem if stems.count(clip.path.stem) == 1 else str(clip.path)) for clip in clips}
