"""A network's last layer, solved where training only comes near it: of what the features say, the least error of the picture.

What that layer adds to the picture is linear in the features, so the squared error of a clip is a quadratic of the layer's weights, and one
matrix and one vector are all of the clip that has to be known. PSNR is the error's logarithm: a clip weighed by the inverse of its error,
and the weights solved for again until they stay (iteratively reweighted least squares), comes to rest where the sum of the logarithms,
which is what `--loss psnr` trains for, has no slope; as there, what is nearer than rounding takes it counts no more. Training sees crops
where detail is; here all of a frame counts, as it does in PSNR. What the layer reads may come in 8 bits, of an int8 artifact or of
bfloat16: weights that live on differences of features would be lost there, so it is solved for features that are off by as much.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import Tensor
from torch.nn import functional as F

from client.artifact import load_session
from client.errors import InputError, ModelError
from model.artifact_files import Page, write_artifact
from model.artifact_weights import network_of_artifact
from model.footage import Pair, Take
from model.losses import MSE_FLOOR
from model.planes import LastLayer, Network, Planes
from model.train import source_commit

FRAMES = 24  # of each clip, over which a state is carried
EVERY = 6  # of which one in so many is looked at
SHARE = 1 / 9  # of its cells, others in every frame of every clip: what lies in the same place in all of a game, as its HUD, is no sample
ROUNDS = 12  # more change nothing that a float32 holds
STEPS = 255  # from the lowest to the highest value of a channel, in an int8 artifact
RIDGE = 1e-7  # of the mean square of a feature: for features that are never anything but zero

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sums:
    """Of one clip: means over cells of features by features (F, F), features by errors (F, O) and squared errors (O,), in codes squared.

    `reach` is the distance from the lowest to the highest value of what gave each feature (F,); 0 of the one that stands for the biases.
    """

    features: Array
    errors: Array
    squared: Array
    reach: Array

    def after(self, change: Array, outputs: slice) -> float:
        """The mean squared error of some outputs once (F, O) `change` has been added to the weights that make them."""
        by_output = self.squared[outputs] + ((self.features @ change - 2 * self.errors[:, outputs]) * change).sum(0)
        return max(0.0, float(by_output.mean()))  # of a clip that comes out right the sum rounds to either side of nothing

    def rounded(self, reach: Array, weights: Array) -> Sums:
        """The same of features that are rounded to STEPS of `reach`, for a layer whose weights are (F, O) `weights`."""
        noise = (reach / STEPS) ** 2 / 12
        lost = noise[:, None] * weights
        return Sums(self.features + np.diag(noise), self.errors - lost, self.squared + (lost * weights).sum(0), reach)


def sums_of(network: Network, layer: LastLayer, pair: Pair) -> Sums:
    """Play a clip through a float32 network in the form that runs, and take the sums of it; a pure function of its arguments."""
    frames = min(len(pair), FRAMES)
    features: list[Tensor] = []
    hook = layer.module.register_forward_pre_hook(lambda module, inputs: features.append(inputs[0][:, : layer.features]))
    sums: list[Any] = [0, 0, 0]
    reach: list[Tensor] = []
    looked_at = range(min(2, frames - 1), frames, EVERY)
    places = np.random.default_rng(list(pair.title.encode()))
    try:
        with torch.no_grad():
            state = network.initial_state(1, pair.low.height, pair.low.width)
            for index in range(frames) if state is not None else looked_at:
                cells: list[Tensor] = []
                features.clear()
                _, state = network.step(_planes(pair.low, index), state, _kept_in(cells))
                if index in looked_at:
                    wanted = torch.cat(
                        [F.pixel_unshuffle(plane, side) for plane, side in zip(_planes(pair.high, index), layer.sides, strict=True)], 1
                    )
                    new = _sums(features[0], wanted - torch.cat(cells, 1), layer.padding, places)
                    sums = [old + part / len(looked_at) for old, part in zip(sums, new, strict=True)]
                    reach.append(torch.stack(torch.aminmax(features[0].flatten(2), dim=2)))
    finally:
        hook.remove()
    lowest, highest = torch.stack(reach)[:, :, 0].unbind(1)
    of_channels = (highest.amax(0) - lowest.amin(0)).double().numpy()
    by_features, by_errors, squared = map(np.asarray, sums)
    return Sums(by_features, by_errors, squared, np.append(np.repeat(of_channels, 9), 0))


def _kept_in(cells: list[Tensor]) -> Callable[[Tensor], Tensor]:
    def keep(samples: Tensor) -> Tensor:
        cells.append(samples)
        return samples

    return keep


def _sums(features: Tensor, errors: Tensor, padding: int, places: np.random.Generator) -> list[Array]:
    """Of one frame; a one beside the features stands for the biases."""
    padded = F.pad(features[0], (padding,) * 4)
    columns, cells = errors.shape[3], errors.shape[2] * errors.shape[3]
    chosen = torch.from_numpy(places.permutation(cells)[: max(1, round(SHARE * cells))])
    corners = chosen // columns * padded.shape[2] + chosen % columns  # of each one's window of 3x3
    offsets = (torch.arange(3)[:, None] * padded.shape[2] + torch.arange(3)).flatten()
    windows = padded.flatten(1)[:, (corners[:, None] + offsets).flatten()].reshape(len(padded), len(chosen), 9)
    x = torch.cat((windows.permute(1, 0, 2).flatten(1), torch.ones(len(chosen), 1)), 1).double()
    e = errors[0].flatten(1).T[chosen].double()
    return [(part / len(chosen)).numpy() for part in (x.T @ x, x.T @ e, (e**2).sum(0))]


def _planes(take: Take, index: int) -> Planes:
    return Planes(*(torch.from_numpy(plane[index].astype(np.float32))[None, None] for plane in take.planes()))


def solved(clips: Iterable[tuple[float, Sums]], outputs: slice) -> Array:
    """The change (F, O) of some outputs' weights that leaves the least sum of the logarithms of the clips' errors, each at its share."""
    shares, sums = zip(*clips, strict=True)
    size = len(sums[0].squared[outputs])
    change = np.zeros((len(sums[0].features), size))
    for _ in range(ROUNDS):
        weights = [share / (clip.after(change, outputs) + MSE_FLOOR) for share, clip in zip(shares, sums, strict=True)]
        matrix = sum(weight * clip.features for weight, clip in zip(weights, sums, strict=True))
        vector = sum(weight * clip.errors[:, outputs] for weight, clip in zip(weights, sums, strict=True))
        change = np.linalg.solve(matrix + RIDGE * np.trace(matrix) / len(matrix) * np.eye(len(matrix)), vector)
    return change


def shares_of(titles: Sequence[str], degradations: Sequence[str]) -> list[float]:
    """What clips count for: each game as much, in it each scene, of a scene each degradation as often as it is named."""
    often = Counter(degradations)
    scenes = {title.split()[0] for title in titles}
    of_game = Counter(scene.split("/")[0] for scene in scenes)
    total = Counter[str]()
    for title in titles:
        scene, how = title.split()
        total[scene] += often[how]
    return [often[how] / total[scene] / of_game[scene.split("/")[0]] for scene, how in (title.split() for title in titles)]


class Refit:
    """An artifact's last layer, to be solved on some clips and looked at on others.

    Raises ModelError for an artifact that is not a float32 network of ours which ends in one layer.
    """

    def __init__(self, artifact: Path) -> None:
        _, spec = load_session(artifact, "cpu", 1)
        if spec.precision != "float32":
            raise ModelError(f"{artifact} is {spec.precision}: refit the float32 artifact that it was made from, and quantize that")
        self.artifact, self.spec = artifact, spec
        self.network = network_of_artifact(artifact).float()
        layer = self.network.last_layer()
        if layer is None:
            raise ModelError(
                f"{artifact} has more than one layer between its features and its picture: only GameSR networks on planes are refitted"
            )
        self.layer = layer
        self.train: dict[str, Sums] = {}
        self.held_out: dict[str, Sums] = {}

    def solve(self, degradations: Sequence[str]) -> dict[str, list[float]]:
        """Change the network by what `train` says; gives what Y, U and V of each held-out clip gain by it, in dB before rounding.

        `degradations` are those of the clips, named as often as they count. Raises InputError where there is no clip.
        """
        if not self.train:
            raise InputError("there is nothing to solve for: no training scene has a film of such an input")
        planes = list(self._planes())
        shares = shares_of(list(self.train), degradations)
        reach = np.max([sums.reach for sums in self.train.values()], 0)
        weights = self._weights()
        train = [sums.rounded(reach, weights) for sums in self.train.values()]
        changes = [solved(zip(shares, train, strict=True), plane) for plane in planes]
        self._add(torch.from_numpy(np.concatenate(changes, 1).T / self.layer.gain).float())
        return {
            title: [
                float(10 * np.log10((sums.squared[plane].mean() + MSE_FLOOR) / (sums.after(change, plane) + MSE_FLOOR)))
                for change, plane in zip(changes, planes, strict=True)
            ]
            for title, sums in self.held_out.items()
        }

    def _planes(self) -> Iterator[slice]:
        first = 0
        for side in self.layer.sides:
            yield slice(first, first + side**2)
            first += side**2

    @torch.no_grad()
    def _weights(self) -> Array:
        """Of the layer as it is (F, O), in codes; the biases last."""
        weights = [weight[:, : self.layer.features].flatten(1) for weight in self.layer.weights]
        whole = torch.cat((torch.cat(weights), torch.cat(list(self.layer.biases))[:, None]), 1)
        return (self.layer.gain * whole.double()).numpy().T

    @torch.no_grad()
    def _add(self, change: Tensor) -> None:
        sizes = [len(weight) for weight in self.layer.weights]
        for part, weight, bias in zip(torch.split(change, sizes), self.layer.weights, self.layer.biases, strict=True):
            weight[:, : self.layer.features] += part[:, :-1].reshape(len(part), -1, 3, 3)
            bias += part[:, -1]

    def write(self, path: Path, *, name: str, facts: Mapping[str, Any], page: Page | None = None) -> None:
        """The artifact with the network's weights in place of its own, everything else as it was; `facts` go into the card."""
        model = onnx.load(self.artifact)
        tensors = {tensor.name: tensor for tensor in model.graph.initializer}
        for key, weight in self.network.state_dict().items():
            tensor = tensors[f"network.{key}"]
            tensor.CopyFrom(numpy_helper.from_array(weight.numpy().reshape(tuple(tensor.dims)), tensor.name))
        # Of an earlier one nothing is left: what is solved for does not depend on what the layer was.
        card = {**self.spec.card, "refit": {**facts, "commit": source_commit()}}
        metadata = {entry.key: entry.value for entry in model.metadata_props}
        helper.set_model_props(model, {**metadata, "name": name, "card": json.dumps(card)})
        onnx.checker.check_model(model, full_check=True)
        write_artifact(model, path, page and page(name, self.spec.scale, card))
