"""What the recurrent state should do while the picture is damaged: five rules on the very same packets.

    python -m server.damage_trial CLIP [CLIP ...] [--model NAME] [--seeds N] > FILE.jsonl

Each clip is cropped to 384x224 in its middle, sent at 192x112, and shown by every rule. One JSON object a
run; with a file of them (.jsonl) in the clips' place, the table.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, stdev

import numpy as np

from client.cloud import NetworkSettings, area_downscale
from client.frames import Frame
from client.models import find_model
from client.quality import psnr_db
from client.upscaler import OnnxUpscaler
from client.video import VideoSource
from server.crossing import Clip, watch
from server.encoding import clip_frames
from server.link import Weather

HEIGHT, WIDTH = 224, 384
RULES = ("restart both", "carry", "restart begin", "restart end", "halve", "halve, restart end")

# Name, intra-refresh, link, pictures: so that damage comes and goes.
RUNS = (
    ("IDR, 2%", False, Weather(loss=0.02), 60),
    ("intra-refresh, 0.5%", True, Weather(loss=0.005), 90),
    ("IDR, 4% in bursts of 8", False, Weather(loss=0.04, burst_packets=8), 60),
    ("intra-refresh, 2% in bursts of 16", True, Weather(loss=0.02, burst_packets=16), 90),
)
AFTER = 8


@dataclass
class Kept:
    height: int
    width: int
    key: tuple[int, ...]
    tensors: list[np.ndarray] | None
    restarted: bool = False
    computed_share: float = 1.0


class Shared:
    """The network's steps: what several rules would compute in the same way is computed once."""

    def __init__(self, upscaler: OnnxUpscaler) -> None:
        self._upscaler = upscaler
        self._done: dict[tuple[int, ...], tuple[Frame, list[np.ndarray]]] = {}
        self._index = -1

    def step(self, index: int, frame: Frame, state: Kept) -> tuple[Frame, list[np.ndarray]]:
        if index != self._index:
            self._index, self._done = index, {}
        if state.key not in self._done:
            if state.tensors is None:
                before = self._upscaler.initial_state(frame.height, frame.width)
            else:
                before = self._upscaler.state_of(frame.height, frame.width, state.tensors)
            picture, after = self._upscaler.step(frame, before)
            self._done[state.key] = picture, [tensor.copy() for tensor in after.tensors()]
        return self._done[state.key]


class Ruled:
    """An upscaler that does with its state what a rule says, whatever the pipeline says."""

    def __init__(self, shared: Shared, rule: str) -> None:
        self._shared, self._rule = shared, rule
        self._index, self._damaged = -1, False
        self._kept: Kept | None = None

    def initial_state(self, height: int, width: int) -> Kept:
        return self._kept or Kept(height, width, (0,), None)

    def step(self, frame: Frame, state: Kept) -> tuple[Frame, Kept]:
        self._index += 1
        begins, ends = frame.damaged and not self._damaged, self._damaged and not frame.damaged
        self._damaged = frame.damaged
        if (begins and self._rule in ("restart both", "restart begin")) or (
            ends and self._rule in ("restart both", "restart end", "halve, restart end")
        ):
            state = replace(state, key=(self._index,), tensors=None)
        elif frame.damaged and self._rule.startswith("halve"):
            assert state.tensors is not None
            state = replace(state, key=(*state.key, self._index), tensors=[tensor / 2 for tensor in state.tensors])
        picture, tensors = self._shared.step(self._index, frame, state)
        self._kept = replace(state, tensors=tensors)
        return picture, self._kept


class Crop(Clip):
    def __init__(self, path: Path, frames: int) -> None:
        with VideoSource(path) as source:
            self.fps = round(source.frame_rate)
        self.name, self.scale = path.stem, 2
        self.references, self.reduced = [], []
        for frame in clip_frames(path, 1, frames):
            top, left = ((side - size) // 4 * 2 for side, size in ((frame.height, HEIGHT), (frame.width, WIDTH)))
            y = frame.y[top : top + HEIGHT, left : left + WIDTH].copy()
            u, v = (p[top // 2 : (top + HEIGHT) // 2, left // 2 : (left + WIDTH) // 2].copy() for p in (frame.u, frame.v))
            self.references.append(y)
            self.reduced.append(area_downscale(replace(frame, y=y, u=u, v=v), 2))


def mean_psnr(errors: Sequence[float]) -> float:
    return psnr_db(fmean(errors))


def summarise(path: Path) -> None:
    """The table of what a file of runs holds: PSNR-Y of the mean error, and the mean over runs of the mean gain of a picture, in mdB."""
    runs = [json.loads(line) for line in path.read_text().splitlines()]
    for parts in ([(run["clip"], run["run"]) for run in runs], [("all", "all") for _ in runs]):
        for clip, name in dict.fromkeys(parts):
            chosen = [run for run, part in zip(runs, parts, strict=True) if part == (clip, name)]
            for rule in RULES:
                cells = [clip, name, str(len(chosen)), rule]
                for part in ("all", "damaged", "after"):
                    errors, gains = [], []
                    for run in chosen:
                        wanted = which(run["views"], part)
                        ours, base = ([e for e, want in zip(run["errors"][r], wanted, strict=True) if want] for r in (rule, RULES[0]))
                        errors += ours
                        if ours:
                            gains.append(fmean(psnr_db(o) - psnr_db(b) for o, b in zip(ours, base, strict=True)) * 1000)
                    error = stdev(gains) / len(gains) ** 0.5 if len(gains) > 1 else 0.0
                    cells += [f"{mean_psnr(errors):.3f}", f"{fmean(gains):+.1f} ± {error:.1f}"] if gains else ["-", "-"]
                print("| " + " | ".join(cells) + " |")


def which(views: Sequence[str], part: str) -> list[bool]:
    damaged = [view == "DAMAGED" for view in views]
    if part == "damaged":
        return damaged
    after = [view == "CLEAN" and any(damaged[max(0, i - AFTER) : i]) for i, view in enumerate(views)]
    return after if part == "after" else [True] * len(views)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--model", default="gamesr")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--kbps", type=int, default=2000)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--runs", type=int, nargs="+", default=list(range(len(RUNS))))
    arguments = parser.parse_args()
    if arguments.clips[0].suffix == ".jsonl":
        return summarise(arguments.clips[0])
    upscaler = OnnxUpscaler(find_model(arguments.model, 2), threads=1)
    clips = [Crop(path, 60) for path in arguments.clips]
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    for seed, number, clip in itertools.product(seeds, arguments.runs, clips):
        name, refresh, weather, pictures = RUNS[number]
        shared = Shared(upscaler)
        rules = {rule: Ruled(shared, rule) for rule in RULES}
        settings = NetworkSettings(arguments.kbps, clip.fps, intra_refresh=refresh)
        seen = watch(clip, settings, weather, seed, pictures, rules)
        row = {"clip": clip.name, "model": arguments.model, "run": name, "seed": seed}
        views = [view.name for view in seen.views]
        print(json.dumps({**row, "packets": seen.packets, "lost": seen.lost, "views": views, "errors": seen.errors}), flush=True)


if __name__ == "__main__":
    main()
