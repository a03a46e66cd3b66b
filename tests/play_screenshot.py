"""A picture of the player's window: `python -m tests.play_screenshot OUT.png`, on a screen that nobody looks at (xvfb)."""

from __future__ import annotations

import os
import sys
from itertools import islice
from pathlib import Path

from PIL import Image

from client.baselines import Baselines
from client.models import DEFAULT_MODEL, find_model
from client.pipeline import upscale_stream
from client.sink import NullSink
from client.timing import stage_latencies
from client.upscaler import OnnxUpscaler
from client.video import VideoSource
from client.window import Window
from tests.headless import headless_screen
from tests.serving import ROOT

CLIP = ROOT / "tests/footage/oa_koth1_540p.mp4"
FRAMES = 8  # the network has a memory by then


def main() -> None:
    path = Path(sys.argv[1])
    with headless_screen(1920, 1080) as screen:
        os.environ["DISPLAY"] = screen.display
        with Window("GameSR") as window:
            play(window)
            Image.fromarray(screen.picture()).save(path, optimize=True)
    print(path, path.stat().st_size)


def play(window: Window) -> None:
    """Bicubic left of the wipe, ours right of it, and how long it took."""
    upscaler = OnnxUpscaler(find_model(DEFAULT_MODEL, 2), provider="cpu", threads=1)
    baselines = Baselines(("bicubic",), 2, provider="cpu", threads=1)
    stamps = []
    with VideoSource(CLIP) as source:
        upscaler.warm_up(source.height, source.width)
        for done in islice(upscale_stream(source, upscaler, NullSink()), FRAMES):
            stamps.append(done.stamps)
            latencies = stage_latencies(stamps)
            overlay = [f"{stage:8s}p50 {latencies[stage].p50 / 1000:6.1f} ms" for stage in ("decode", "upscale")]
            window.present(done.picture, left=baselines.upscale(done.decoded)["bicubic"], overlay=["bicubic | GameSR", *overlay])
            window.actions()


if __name__ == "__main__":
    main()
