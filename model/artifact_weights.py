"""The weights inside an artifact: as the network that runs, to be held against, and as one that training goes on from."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any

import onnx
import torch
from onnx import numpy_helper

from client.artifact import ModelSpec, load_session
from client.errors import ModelError
from client.models import shipped_models
from model.catalogue import described_network, preset_of
from model.planes import Network

ORIGINALS = Path(__file__).parent / "originals"  # float32 artifacts that only int8 ones were made from
RUN = ("command", "steps", "training_seconds")  # what a card says of a run that another is built on


def averaging(card: dict[str, Any]) -> str:
    """What a card's `averaged` says, in words."""
    return f"{card['share']:.0%} of the weights are those of the artifact {card['with']} (SHA-256), from which the run began"


def refitting(card: dict[str, Any]) -> str:
    """What a card's `refit` says, in words."""
    inputs = " ".join(card["degradations"])
    return f"the last layer is solved on the first {card['frames']} frames of each scene ({inputs}), commit {card['commit']}"


def network_of_artifact(artifact: Path, weights: Path | None = None) -> Network:
    """The fused network in float64 with an artifact's weights; raises ModelError when the artifact is not the network that it says.

    The weights of an int8 artifact are those of the float32 artifact that it was made from: `weights`, or one that ships.
    """
    _, spec = load_session(artifact, "cpu", 1)
    if "network" not in spec.card:
        raise ModelError(f"{artifact} is no network: only a trained artifact has weights to verify")
    if weights is not None and load_session(weights, "cpu", 1)[1].sha256 != spec.card.get("quantized_from"):
        raise ModelError(f"{artifact} was not made from {weights}")
    if weights is None and spec.precision == "int8":
        weights = _original(spec)
        if weights is None:
            raise ModelError(f"{artifact} has rounded weights: name the float32 artifact that it was made from with --weights")
    network = described_network(spec.card["network"]).deployed()
    side = spec.size_multiple
    remembered = [(1, part.channels, side // part.divisor, side // part.divisor) for part in spec.state]
    zeros = network.initial_state(1, side, side) or ()
    if (network.scale, network.size_multiple, [part.shape for part in zeros]) != (spec.scale, side, remembered):
        raise ModelError(f"{artifact} has another scale or another state than the network that it says it is")
    initializers = onnx.load(weights or artifact).graph.initializer
    found = {tensor.name.removeprefix("network."): tensor for tensor in initializers}
    shapes = {name: weight.shape for name, weight in network.state_dict().items()}
    missing = shapes.keys() - found.keys()
    if missing:
        raise ModelError(f"{artifact} lacks the weights {', '.join(sorted(missing))}")
    try:  # slopes of PReLU lie over channels
        network.load_state_dict({name: torch.tensor(numpy_helper.to_array(found[name]).reshape(shape)) for name, shape in shapes.items()})
    except (TypeError, ValueError) as error:
        raise ModelError(f"{artifact} has other weights than the network that it says it is") from error
    return network.double().eval()


def _original(spec: ModelSpec) -> Path | None:
    """The float32 artifact that ships and that an int8 one says it was made from."""
    of = spec.card.get("quantized_from")
    return next((path for path in (*ORIGINALS.glob("*.onnx"), *shipped_models()) if sha256(path.read_bytes()).hexdigest() == of), None)


def run_of_artifact(artifact: Path) -> dict[str, Any]:
    """What a checkpoint would say that the artifact could have been exported from, as far as another run can build on it.

    `network` is a training form that deploys to the artifact's weights; what chance there is in it is torch's. `before` are the runs that
    made it, oldest first, and `preset` its network's. Raises ModelError for an artifact that holds no network's float32 weights.
    """
    spec = load_session(artifact, "cpu", 1)[1]
    if spec.precision == "int8":
        raise ModelError(f"{artifact} has rounded weights: begin with the float32 artifact that it was made from")
    card, deployed = spec.card, network_of_artifact(artifact)
    network = described_network(card["network"])
    network.load_deployed(deployed)
    runs = [*card.get("before", ()), {name: card[name] for name in RUN if name in card}]
    if "averaged" in card:
        runs.append({"command": averaging(card["averaged"]), "steps": 0, "training_seconds": 0})
    if "refit" in card:
        runs.append({"command": refitting(card["refit"]), "steps": 0, "training_seconds": 0})
    return {
        "network": network.state_dict(),
        "before": [run for run in runs if run.keys() == set(RUN)],
        "preset": preset_of(card["network"]),
    }
