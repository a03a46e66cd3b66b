"""How long a recurrent network settles on a still: `python -m tests.settling CLIP_1080p... [--model M] [--kbps N]` prints a table.

Of the middle 480x272 of each clip: twelve frames of motion, then the last decoded one 200 times, all computed. How much of the luma
still differs from the 200th picture, by how many code values at most, and PSNR-Y against the original.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from client.cloud import CloudSettings, area_downscale
from client.frames import Frame
from client.models import find_model
from client.quality import psnr_db, squared_error
from client.upscaler import OnnxUpscaler
from model.verify import crop
from server.encoding import EncodedStream, clip_frames

WIDTH, HEIGHT = 480, 272
MOTION, STILL = 12, 200
AFTER = (0, 1, 4, 8, 16)


def inputs(originals: list[Frame], kbps: int | None) -> Iterator[Frame]:
    small = [area_downscale(frame, 2) for frame in originals]
    if kbps is None:
        yield from small
        return
    with EncodedStream(iter(small), CloudSettings(kbps, 60)) as stream:
        yield from (decoded.frame for decoded in stream)


def row(name: str, originals: list[Frame], kbps: int | None, upscaler: OnnxUpscaler) -> str:
    frames = list(inputs(originals, kbps))
    state = upscaler.initial_state(frames[0].height, frames[0].width)
    pictures = []
    for number in range(len(frames) + STILL):
        picture, state = upscaler.step(frames[min(number, len(frames) - 1)], state)
        if number >= len(frames) - 1:
            pictures.append(picture.y)
    last = pictures[-1]
    differences = [np.abs(np.subtract(picture, last, dtype=np.int16)) for picture in pictures]
    cells = [f"{100 * np.mean(differences[n] > 0):.2f}%, {differences[n].max()}" for n in AFTER]
    same_after = 1 + max((n for n, difference in enumerate(differences) if difference.any()), default=-1)
    decibels = [psnr_db(squared_error(originals[-1].y, picture) / last.size) for picture in (pictures[0], last)]
    source = "uncompressed" if kbps is None else f"{kbps} kbps"
    return f"| {name}, {source} | " + " | ".join(cells) + f" | {same_after} | {decibels[0]:.3f}, {decibels[1]:.3f} |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="tests.settling")
    parser.add_argument("clips", nargs="+", type=Path, metavar="CLIP_1080p")
    parser.add_argument("--model", default="gamesr", metavar="M")
    parser.add_argument("--kbps", type=int, default=800, metavar="N")
    arguments = parser.parse_args()
    upscaler = OnnxUpscaler(find_model(arguments.model, 2))
    heads = ["clip, input", "at once", *(f"after {n}" for n in AFTER[1:]), "same for good after", "PSNR-Y at once, in the end"]
    print("| " + " | ".join(heads) + " |")
    print("|---" * len(heads) + "|")
    for path in arguments.clips:
        originals = [crop(frame, WIDTH, HEIGHT) for frame in clip_frames(path, 1, MOTION)]
        for kbps in (None, arguments.kbps):
            print(row(path.stem.removesuffix("_1080p"), originals, kbps, upscaler), flush=True)


if __name__ == "__main__":
    main()
