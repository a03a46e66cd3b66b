"""Every network that can be trained, by the name of its preset, and again from what a checkpoint or an artifact says of it."""

from __future__ import annotations

from typing import Any

from client.errors import ModelError
from model.lean import ARCHITECTURE, LEAN, Lean, LeanConfig
from model.network import PRESETS, GameSR, NetworkConfig
from model.peers import PEERS
from model.planes import Network

NAMES = (*PRESETS, *LEAN, *PEERS)


def network_of_preset(preset: str, scale: int) -> Network:
    """An untrained network; `preset` is one of NAMES."""
    if preset in LEAN:
        return described_network({"architecture": ARCHITECTURE, "scale": scale, **LEAN[preset]})
    return described_network({"architecture": preset, "scale": scale} if preset in PEERS else {"scale": scale, **PRESETS[preset]})


def preset_of(description: dict[str, Any]) -> str | None:
    """The preset that a network's own `description` is of, at whatever scale; None where it is of none."""
    for preset in NAMES:
        if network_of_preset(preset, 2).description == {**described_network(description).description, "scale": 2}:
            return preset
    return None


def described_network(description: dict[str, Any]) -> Network:
    """An untrained network from its own `description`; raises ModelError for one of another version's, or none at all."""
    try:
        shape = dict(description)
        architecture = shape.pop("architecture", None)
        if architecture in PEERS:
            around, body = PEERS[architecture]
            return around(architecture, body, **shape)
        if architecture == ARCHITECTURE:
            return Lean(LeanConfig(**shape))
        if architecture is None:
            return GameSR(NetworkConfig(**shape))
    except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:  # an argument that is none, or a size that none can have
        raise ModelError(f"this version has no such network: {str(error).splitlines()[0]}") from error
    raise ModelError(f"this version has no network of the architecture {architecture}")
