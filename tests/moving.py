"""A moving texture, as frames and as footage for training."""

from __future__ import annotations

import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from client.frames import Frame
from client.video import to_av_frame


def picture(t: int, height: int = 96, width: int = 144) -> Frame:
    """A texture that moves two pixels a frame."""
    rows, columns = np.mgrid[:height, :width]
    luma = 128 + 60 * np.sin((columns + 2 * t) / 3) * np.cos(rows / 4)
    chroma = np.full((height // 2, width // 2), 100 + t)
    return Frame(luma.astype(np.uint8), chroma.astype(np.uint8), (chroma + 30).astype(np.uint8))


def write_footage(folder: Path) -> Path:
    """A footage list of five scenes of two games, all of them the same 12 frames, 144x96; the first has a native 48p render."""
    write_clip(folder / "clip.mkv", 96, 144)
    write_clip(folder / "native.mkv", 48, 72)
    films = {"train": "clip.mkv", "validate": "validate.mkv", "test": "test.mkv"}
    for film in ("validate.mkv", "test.mkv"):
        shutil.copy(folder / "clip.mkv", folder / film)
    rows = [("one", "a", "train"), ("two", "b", "train"), ("three", "b", "train"), ("four", "a", "validate"), ("five", "a", "test")]
    scenes = [scene(name, game, split, films[split]) for name, game, split in rows]
    scenes[0] += 'native = { 48 = "native.mkv" }\n'
    (folder / "footage.toml").write_text("\n".join(scenes))
    return folder / "footage.toml"


def scene(name: str, game: str, split: str, film: str, fps: int = 30) -> str:
    """A table of a footage list."""
    return f'[[scene]]\nname = "{name}"\ngame = "{game}"\nsplit = "{split}"\nfps = {fps}\nreference = "{film}"\n'


def write_clip(path: Path, height: int, width: int, frames: int = 12) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "4", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for t in range(frames):
            frame = to_av_frame(picture(t, height, width))
            frame.pts, frame.time_base = t, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
