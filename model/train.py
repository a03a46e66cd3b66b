"""Training: truncated back-propagation through time over clips, resumable to the same weights."""

from __future__ import annotations

import json
import math
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from client.errors import InputError, ModelError, ProviderError
from model.artifact_weights import run_of_artifact
from model.catalogue import NAMES, network_of_preset
from model.footage import Degradation, FootageCache, load_pairs, load_scenes
from model.held_out import gain_db, psnr_y_beside_bicubic
from model.lean import Lean
from model.losses import LOSSES, charbonnier, mean_log_mse
from model.planes import Network, Planes, State, to_planes
from model.rounding import RoundedFeatures
from model.sampling import by_game, sample_clips

CHECKPOINT_FORMAT = 1
SAVED = ("config", "footage", "before", "commit", "device", "network", "optimizer", "step", "seconds", "held_out")


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the weights, besides the footage's content; saved in every checkpoint.

    A step is one optimizer update on `batch` crops of `window` frames; `frames` consecutive ones of the same crops are
    `frames / window` steps, between which the state is carried but not differentiated. `patch` is in low-resolution pixels.
    A degradation named twice is drawn twice as often.
    The learning rate is halved `halvings` times over the run, as the paper halves it every 200,000 iterations.
    """

    preset: str = "planes"
    scale: int = 2
    games: tuple[str, ...] = ()
    degradations: tuple[str, ...] = ("area", "area", "area", "area@2000", "area@4000", "area@8000")
    steps: int = 5000
    batch: int = 8
    patch: int = 64
    frames: int = 10
    window: int = 5
    learning_rate: float = 1e-3
    halvings: int = 6
    warm_up_steps: int = 100
    weight_decay: float = 1e-4
    loss: str = "charbonnier"
    charbonnier_eps: float = 1e-3
    clip_norm: float = 1.0
    seed: int = 0
    bfloat16: bool = False
    initial_weights: str = ""
    int8: bool = False

    def __post_init__(self) -> None:
        if self.preset not in NAMES:
            raise InputError(f"no network is called {self.preset!r}: there are {', '.join(NAMES)}")
        if self.loss not in LOSSES:
            raise InputError(f"no loss is called {self.loss!r}: there are {', '.join(LOSSES)}")
        if self.frames % self.window or self.patch % 2:
            raise InputError("the clip length must be a multiple of the window, and the patch even")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0):
            raise InputError(f"the learning rate is a number above 0, not {self.learning_rate}")

    def network(self) -> Network:
        """The untrained network."""
        return network_of_preset(self.preset, self.scale)

    def rate_at(self, step: int) -> float:
        warm = min(1.0, (step + 1) / self.warm_up_steps)
        return self.learning_rate * warm * 0.5 ** int((self.halvings + 1) * step / self.steps)


class Trainer:
    """One run in one folder: `checkpoint.pt` (whole or not there) and `log.jsonl`."""

    def __init__(
        self, config: TrainConfig, footage: Path, cache: FootageCache, folder: Path, *, device: str = "cpu", compiled: bool = False
    ):
        self.folder, self.config, self.device = folder, config, _device(device)
        degradations = [Degradation.parse(text) for text in config.degradations]
        self.train = load_pairs(load_scenes(footage, split="train", games=config.games), cache, config.scale, degradations)
        held_out = load_scenes(footage, split="validate", games=config.games)
        self.validate = load_pairs(held_out, cache, config.scale, dict.fromkeys(degradations))
        for split, pairs in (("train", self.train), ("validate", self.validate)):
            if not pairs:
                raise InputError(f"no {split} scene of {footage} was rendered for {' or '.join(dict.fromkeys(config.degradations))}")
        short = [pair.title for takes in self.train for pair in takes if len(pair) < config.frames]
        if short:
            raise InputError(f"{short[0]} is shorter than a clip of {config.frames} frames")
        small = [pair for takes in self.train for pair in takes if min(pair.low.height, pair.low.width) < config.patch]
        if small:
            low = small[0].low
            raise InputError(f"{small[0].title} is {low.width}x{low.height} at 1/{config.scale}, smaller than a patch of {config.patch}")
        torch.manual_seed(config.seed)
        self.network = config.network().to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.before: list[dict[str, Any]] = []  # the runs that this one builds on, oldest first
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, betas=(0.9, 0.999), weight_decay=config.weight_decay
        )
        self.rounded = RoundedFeatures(self.network, config.seed) if config.int8 else None
        self.forward: Any = torch.compile(self.network) if compiled else self.network
        self.footage = {
            split: [f"{pair.title.split()[0]} ({len(pair)} frames)" for pair in (takes[0] for takes in pairs)]
            for split, pairs in (("train", self.train), ("validate", self.validate))
        }
        self.commit = source_commit()
        self.step = 0
        self.seconds = 0.0
        self.held_out: dict[str, dict[str, float | None]] = {}
        if (folder / "checkpoint.pt").exists():
            self._resume(folder / "checkpoint.pt")  # whatever has become of what it started from
        elif config.initial_weights:
            self._start_from(Path(config.initial_weights))
        folder.mkdir(parents=True, exist_ok=True)

    def _resume(self, path: Path) -> None:
        saved = load_checkpoint(path)
        for what, theirs, ours in (
            ("another configuration", saved["config"], asdict(self.config)),
            ("other footage", saved["footage"], self.footage),
        ):
            different = [k for k, v in ours.items() if theirs.get(k) != v]
            if different:
                raise InputError(f"{self.folder} holds a run of {what} ({', '.join(different)}): choose another folder")
        try:
            self.network.load_state_dict(saved["network"])
            self.optimizer.load_state_dict(saved["optimizer"])
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise ModelError(f"{path} has other weights than a run of its own configuration") from error
        self.step, self.seconds, self.held_out, self.before = (saved[name] for name in ("step", "seconds", "held_out", "before"))

    def _start_from(self, path: Path) -> None:
        """Take over every weight of the same name and shape; a network of another scale keeps its own head and base.

        A `model.lean` network takes those of a narrower one too.
        """
        if path.suffix == ".onnx":
            earlier = run_of_artifact(path)
            preset, self.before = earlier["preset"], earlier["before"]
        else:
            earlier = load_checkpoint(path)
            preset = earlier["config"]["preset"]
            self.before = [*earlier["before"], {"config": earlier["config"], "step": earlier["step"], "seconds": earlier["seconds"]}]
        own, weights = self.network.state_dict(), earlier["network"]
        if isinstance(self.network, Lean) and weights.keys() == own.keys():
            weights = self.network.widened(weights)
        fitting = {name: value for name, value in weights.items() if name in own and own[name].shape == value.shape}
        first = next(name for name, layer in self.network.named_modules() if isinstance(layer, nn.Conv2d))
        if f"{first}.weight" not in fitting:  # a layer inside fits many a network
            of = f"--preset {preset}" if preset else "no preset"
            raise ModelError(f"{path} has no weight that fits this network: it is one of {of}")
        self.network.load_state_dict({**own, **fitting})

    def save(self) -> None:
        state = {
            "format": CHECKPOINT_FORMAT,
            "config": asdict(self.config),
            "footage": self.footage,
            "before": self.before,
            "commit": self.commit,
            "device": torch.cuda.get_device_name() if self.device.type == "cuda" else f"CPU, threads {torch.get_num_threads()}",
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "held_out": self.held_out,
        }
        partial = self.folder / f"checkpoint.{os.getpid()}.partial"
        try:
            torch.save(state, partial)
            partial.replace(self.folder / "checkpoint.pt")
        finally:
            partial.unlink(missing_ok=True)

    def losses(self) -> Iterator[float]:
        """Train to the last step of the configuration, giving the loss after every step; checkpoints only fall between clips."""
        config = self.config
        per_clip = config.frames // config.window
        while self.step < config.steps:
            arrays = sample_clips(
                by_game(self.train),
                seed=config.seed,
                index=self.step // per_clip,
                batch=config.batch,
                frames=config.frames,
                patch=config.patch,
                scale=config.scale,
            )
            low, high = (to_planes(a, self.device) for a in arrays)
            state = self.network.initial_state(config.batch, config.patch, config.patch)
            for first in range(0, config.frames, config.window):
                if self.step == config.steps:
                    return
                span = slice(first, first + config.window)
                started = time.perf_counter()
                loss, state = self._update(Planes(*(p[:, span] for p in low)), Planes(*(p[:, span] for p in high)), state)
                self.seconds += time.perf_counter() - started
                yield loss

    def _update(self, low: Planes, high: Planes, state: State | None) -> tuple[float, State | None]:
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.rate_at(self.step)
        rounding = self.rounded(self.step) if self.rounded else nullcontext()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.bfloat16), rounding:
            output, state = self.forward(low, state)
        loss = mean_log_mse(output, high) if self.config.loss == "psnr" else charbonnier(output, high, self.config.charbonnier_eps)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip_norm)
        self.optimizer.step()
        self.step += 1
        value = loss.item()
        if not np.isfinite(value):
            raise ModelError(f"the loss is {value} at step {self.step}: lower the learning rate")
        return value, state if state is None else State(*(t.detach() for t in state))

    def validation(self, frames: int = 5) -> dict[str, dict[str, float | None]]:
        """PSNR-Y of the network and of bicubic in dB on the first frames of every held-out take, full size, state carried."""
        return {pair.title: psnr_y_beside_bicubic(self.network, pair, frames) for takes in self.validate for pair in takes}

    def run(self, *, validate_every: int, progress: bool) -> None:
        """Train to the end, validating and saving as it goes, with a progress bar on stderr if wanted."""
        per_clip = self.config.frames // self.config.window
        bar = tqdm(total=self.config.steps, initial=self.step, unit="step", disable=not progress, mininterval=1.0)
        recent: list[float] = []
        gain = ""
        with bar, (self.folder / "log.jsonl").open("a") as log:
            for loss in self.losses():
                recent.append(loss)
                bar.update()
                bar.set_postfix_str(f"loss {fmean(recent[-100:]):.5f} {gain}", refresh=False)
                done = self.step >= self.config.steps
                if done or (self.step % per_clip == 0 and self.step // per_clip % max(1, validate_every // per_clip) == 0):
                    self.held_out = self.validation()
                    self.save()
                    gains = [db for row in self.held_out.values() if (db := gain_db(row)) is not None]
                    gain = f"held-out PSNR-Y over bicubic {fmean(gains):+.2f} dB" if gains else ""
                    row = {"step": self.step, "loss": fmean(recent), "train_s": round(self.seconds, 1), "held_out": self.held_out}
                    log.write(json.dumps(row) + "\n")
                    log.flush()
                    recent.clear()


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (AssertionError, RuntimeError) as error:
        raise ProviderError(f"torch cannot compute on the device {name!r}: {str(error).splitlines()[0]}") from error
    return device


def source_commit() -> str:
    """The commit of the checkout that this code runs from, or "unknown" for an installed package."""
    try:
        command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def load_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's dictionary; raises ModelError when the file is not one. Nothing in it is executed."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error
    except Exception as error:  # torch raises whatever the unpickler met
        raise ModelError(f"{path} is not a checkpoint: {error}") from error
    if not isinstance(saved, dict) or saved.get("format") != CHECKPOINT_FORMAT:
        raise ModelError(f"{path} is not a checkpoint of format {CHECKPOINT_FORMAT}")
    missing = [name for name in SAVED if name not in saved]
    if missing:
        raise ModelError(f"{path} is not a whole checkpoint: it lacks {', '.join(missing)}")
    try:
        saved["config"] = asdict(TrainConfig(**saved["config"]))  # what an older version did not know was the default
    except (InputError, TypeError) as error:
        raise ModelError(f"{path} is of a configuration that this version does not know: {error}") from error
    return saved


def network_of(checkpoint: dict[str, Any]) -> Network:
    """The network in training form with a checkpoint's weights."""
    network = TrainConfig(**checkpoint["config"]).network()
    try:
        network.load_state_dict(checkpoint["network"])
    except (RuntimeError, TypeError) as error:
        raise ModelError("the checkpoint has other weights than the network of its configuration") from error
    return network
