"""The model card: where an artifact's weights come from, as data inside the artifact and as a page beside it."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from client.errors import ModelError
from model.artifact_weights import averaging, refitting
from model.held_out import gain_db
from model.train import TrainConfig

Card = dict[str, Any]


def training_card(checkpoint: dict[str, Any]) -> Card:
    """What a checkpoint knows of its own making, ready for JSON."""
    config = TrainConfig(**checkpoint["config"])
    return {
        "command": training_command(config),
        "before": [_earlier_run(run) for run in checkpoint["before"]],
        "commit": checkpoint["commit"],
        "device": checkpoint["device"] + (", bfloat16" if config.bfloat16 else ""),
        "steps": checkpoint["step"],
        "training_seconds": round(checkpoint["seconds"]),
        "footage": checkpoint["footage"],
        "held_out": checkpoint["held_out"],
    }


def _earlier_run(run: dict[str, Any]) -> Card:
    """A run that another was built on: as an artifact's card says it, or as a checkpoint does."""
    if "config" not in run:
        return run
    return {"command": training_command(TrainConfig(**run["config"])), "steps": run["step"], "training_seconds": round(run["seconds"])}


def training_command(config: TrainConfig) -> str:
    """The command that makes a run of this configuration; what is left out is the default."""
    words = ["gamesr-train", "FOOTAGE.toml", "RUN"]
    for field in fields(TrainConfig):
        value = getattr(config, field.name)
        if value == field.default:
            continue
        words.append("--" + field.name.replace("_", "-"))
        if field.name == "initial_weights":
            words.append(str(Path(*Path(value).parts[-2:])))  # the run's own folder; where that lies is nobody's business
        elif value is not True:
            words += [str(v) for v in value] if isinstance(value, (tuple, list)) else [str(value)]
    return " ".join(words)


def card_page(name: str, scale: int, card: Card) -> str:
    """The card as Markdown; raises ModelError when something is missing in it."""
    try:
        return "\n".join(_lines(name, scale, card)) + "\n"
    except KeyError as missing:
        raise ModelError(
            f"the model's card does not say {missing}, which its page needs: export the model again from its checkpoint"
        ) from None


def _lines(name: str, scale: int, card: Card) -> list[str]:
    precision, made_from = "float32", []
    if "quantized_from" in card:
        precision = "int8"
        made_from = [f"- Quantized from the float32 artifact {card['quantized_from']} (SHA-256) on {', '.join(card['calibration'])}"]
    if "averaged" in card:
        made_from.append(f"- Averaged: {averaging(card['averaged'])}")
    if "refit" in card:
        made_from.append(f"- Refitted: {refitting(card['refit'])}, of {', '.join(card['refit']['scenes'])}")
    steps = (("averaged", "averaged"), ("refit", "refitted"), ("quantized_from", "quantized"))
    changed = " and ".join(done for key, done in steps if key in card)
    earlier = [
        f"- Built on: `{run['command']}`, {run['steps']:,} steps in {run['training_seconds'] / 3600:.2f} h" for run in card["before"]
    ]
    lines = [
        f"# {name} x{scale}",
        "",
        f"{card['parameters']:,} parameters ({card['parameters_in_training']:,} in training), {precision}; "
        f"{card['macs_540p'] / 1e9:.2f} GMAC for a frame of 960x540.",
        "",
        *made_from,
        *earlier,
        f"- Command: `{card['command']}`",
        f"- Commit: {card['commit']}",
        f"- Steps: {card['steps']:,} in {card['training_seconds'] / 3600:.2f} h of training time on {card['device']}",
        f"- Trained on: {', '.join(card['footage']['train'])}",
        f"- Held out while training: {', '.join(card['footage']['validate'])}",
        "",
        f"The first frames of the held-out scenes, PSNR-Y in dB{changed and f', before it was {changed}'}:",
        "",
        "| scene and input | bicubic | this model | gain |",
        "|---|---|---|---|",
    ]
    for title, row in card["held_out"].items():
        bicubic, ours = ("identical" if row[name] is None else f"{row[name]:.2f}" for name in ("bicubic_db", "psnr_y_db"))
        gain = gain_db(row)
        lines.append(f"| {title} | {bicubic} | {ours} | {'undefined' if gain is None else f'{gain:+.2f}'} |")
    lines += [
        "",
        "An input `area` is the reference downscaled by area, `area@4000` the same through x264 at 4000 kbps (zerolatency).",
        "OpenArena's data is GPL-2+; SuperTuxKart's is under CC-BY-SA, CC-BY, CC0 and GPL.",
    ]
    return lines
