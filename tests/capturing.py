"""Clips and games' files for the tests of filming: a real excerpt, clips of given lumas, a game file with two scenes."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from model.capture.library import X264_OPTIONS

EXCERPT = Path(__file__).parent / "footage" / "capture"


def excerpt(height: int) -> Path:
    return EXCERPT / f"oa_dm5_{height}p.mkv"


def write_clip(path: Path, lumas: list[np.ndarray]) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=60, options=dict(X264_OPTIONS))
        stream.height, stream.width = lumas[0].shape
        stream.pix_fmt = "yuv420p"
        for luma in lumas:
            half = np.full((luma.shape[0] // 2, luma.shape[1]), 128, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.vstack([luma, half]), "yuv420p")))
        container.mux(stream.encode(None))
    return path


def write_game(folder: Path, **changes: str) -> Path:
    keys = {"title": '"Test"', "fps": "60", "process": '"python3"', "packages": "[]", "licence": '"none"', "repeatable": "true"}
    keys |= {"native": "true", "world": "[0, 0, 1, 1]", "skip": "0", "frames": "40", "colour": '"red"'} | changes
    folder.mkdir(exist_ok=True)
    lines = [f"{key} = {value}" for key, value in keys.items()]
    lines += ["[play]", 'command = ["game", "$name", "$colour"]', "[[scene]]", 'name = "one"', 'split = "train"']
    lines += ["[[scene]]", 'name = "two"', 'split = "test"', 'colour = "blue"', "antialiased = true"]
    (folder / "test.toml").write_text("\n".join(lines))
    return folder
