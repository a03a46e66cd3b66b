"""A network between two: the weights of one that another was trained on from, averaged with what came of it."""

from __future__ import annotations

import copy
from pathlib import Path

import torch

from client.artifact import load_session
from client.errors import InputError, ModelError
from model.artifact_weights import network_of_artifact
from model.catalogue import described_network
from model.planes import Network


def averaged(network: Network, artifact: Path, share: float) -> Network:
    """A network, in the form that is trained, of whose running weights `share` are the artifact's and the rest are `network`'s.

    Runs that began from the same weights end so near to each other that between them the error is no larger, and mostly smaller, than
    at either (model soups, Wortsman et al. 2022): what the last run forgot comes back. `network` is left as it is. Raises InputError
    for a share that is not between 0 and 1, and ModelError for an artifact that is another network or int8.
    """
    if not 0 < share < 1:
        raise InputError(f"a share of {share} averages nothing: it lies between 0 and 1")
    if load_session(artifact, "cpu", 1)[1].precision == "int8":
        raise ModelError(f"{artifact} has rounded weights: average with the float32 artifact that it was made from")
    ours, theirs = copy.deepcopy(network).double().eval().deployed(), network_of_artifact(artifact)
    if ours.description != theirs.description:
        raise ModelError(f"{artifact} is another network than the checkpoint's: their weights cannot be averaged")
    other = theirs.state_dict()
    ours.load_state_dict({name: (1 - share) * weight + share * other[name] for name, weight in ours.state_dict().items()})
    result = described_network(network.description)
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(0)  # there is chance in a training form, none in what it deploys to
        result.load_deployed(ours)
    return result
