"""Every network that can be trained, by the name of its preset, and again from what a checkpoint or an artifact says of it."""

from __future__ import annotations

from typing import Any

from model.network import PRESETS, GameSR, NetworkConfig
from model.peers import PEERS
from model.planes import Network

NAMES = (*PRESETS, *PEERS)


def network_of_preset(preset: str, scale: int) -> Network:
    """An untrained network; `preset` is one of NAMES."""
    return described_network({"architecture": preset, "scale": scale} if preset in PEERS else {"scale": scale, **PRESETS[preset]})


def described_network(description: dict[str, Any]) -> Network:
    """An untrained network from its own `description`: that of a peer names its architecture, any other is a `NetworkConfig`."""
    if "architecture" in description:
        name, scale = description["architecture"], description["scale"]
        around, body = PEERS[name]
        return around(name, body, scale)
    return GameSR(NetworkConfig(**description))
