"""The published networks beside ours: their printed parameter counts, between planes, through training, export and verification."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from client.frames import Frame
from client.upscaler import OnnxUpscaler
from model.catalogue import described_network, network_of_preset
from model.colour import PlanesToRgb
from model.complexity import macs, parameter_count
from model.export import export_network
from model.footage import FootageCache
from model.peers import PEERS, ContrastAttention, Fsrcnn, Imdn, Srvgg
from model.planes import Planes
from model.train import TrainConfig, Trainer, load_checkpoint, network_of
from model.verify import parity
from tests.moving import write_footage
from tests.networks import random_clip, random_network


@pytest.mark.parametrize(
    ("body", "scale", "parameters"),
    [
        (Imdn, 2, 694_404),  # printed: 694K
        (Imdn, 3, 703_059),  # 703K
        (Imdn, 4, 715_176),  # 715K
        (Srvgg, 4, 621_424),
        (Srvgg, 3, 609_307),
        (Srvgg, 2, 600_652),
        *[(Fsrcnn, scale, 12_464 + 173 + 172) for scale in (2, 3, 4)],  # printed: 12,464, the filters alone
    ],
)
def test_published_parameter_counts(body: type[nn.Module], scale: int, parameters: int) -> None:
    assert parameter_count(body(scale)) == parameters


def test_what_fsrcnn_has_beyond_its_printed_count_are_biases_and_slopes() -> None:
    filters = [p for p in Fsrcnn(2).parameters() if p.dim() == 4]
    assert sum(p.numel() for p in filters) == 12_464


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.parametrize("scale", [2, 3])
@pytest.mark.parametrize("size", [(2, 2), (8, 14), (18, 10)])
def test_an_untrained_peer_gives_a_finite_picture_of_scale_times_the_size(name: str, scale: int, size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    height, width = size
    picture, state = network_of_preset(name, scale).double()(random_clip(2, 3, height, width))
    assert state is None
    assert picture.y.shape == (2, 3, 1, scale * height, scale * width)
    assert picture.u.shape == picture.v.shape == (2, 3, 1, scale * height // 2, scale * width // 2)
    assert all(plane.isfinite().all() for plane in picture)


@pytest.mark.parametrize("name", PEERS)
def test_a_clip_is_its_frames_one_by_one(name: str) -> None:
    network = random_network(name).double()
    clip = random_clip(2, 3, 12, 16)
    whole, _ = network(clip)
    for t in range(3):
        picture, _ = network.step(Planes(*(plane[:, t] for plane in clip)), None)
        for one, many in zip(picture, whole, strict=True):
            torch.testing.assert_close(one, many[:, t], rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [2, 3])
def test_fsrcnns_deconvolution_reaches_evenly_around_each_input_pixel(scale: int) -> None:
    deconv = Fsrcnn(scale).deconv
    nn.init.ones_(deconv.weight)
    source = torch.zeros(1, 56, 15, 15)
    source[0, 0, 7, 7] = 1
    with torch.no_grad():
        lit = deconv(source)[0, 0] - deconv.bias
    rows = lit.sum(1).nonzero().flatten().tolist()
    assert lit.shape == (15 * scale, 15 * scale)
    assert torch.equal(lit, lit.T)
    first = 7 * scale + (scale - 1) // 2 - 4  # nine output pixels about the middle of the input pixel's cell, or just before it
    assert rows == list(range(first, first + 9))


def test_fsrcnn_leaves_chroma_to_bicubic_and_chroma_does_not_touch_luma() -> None:
    clip = random_clip(1, 1, 12, 16)
    network, bicubic = random_network("fsrcnn").double(), network_of_preset("planes", 2).double()
    changed = Planes(clip.y, 255 - clip.u, 255 - clip.v)
    first, second = network(clip)[0], network(changed)[0]
    assert torch.equal(first.y, second.y)
    for found, expected in zip(first[1:], bicubic(clip)[0][1:], strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("scale", [2, 3])
def test_srvgg_is_a_residual_over_the_nearest_pixel(scale: int) -> None:
    body = Srvgg(scale).double()
    rgb = torch.rand(2, 3, 5, 7, dtype=torch.float64)
    residual = F.pixel_shuffle(body.last(body.body(rgb)), scale)
    torch.testing.assert_close(body(rgb) - residual, F.interpolate(rgb, scale_factor=scale, mode="nearest"))


def test_an_rgb_peer_whose_network_repeats_pixels_repeats_flat_colours() -> None:
    network = network_of_preset("srvgg", 2).double()
    assert isinstance(network.body, Srvgg)
    nn.init.zeros_(network.body.last.weight)
    nn.init.zeros_(network.body.last.bias)
    flat = Planes(*(torch.full((1, 1, *size), code, dtype=torch.float64) for size, code in (((8, 8), 90), ((4, 4), 77), ((4, 4), 201))))
    picture, _ = network.step(flat, None)
    for plane, code in zip(picture, (90, 77, 201), strict=True):
        torch.testing.assert_close(plane, torch.full_like(plane, code))
    assert PlanesToRgb().double()(*flat).shape == (1, 3, 8, 8)


def test_attention_weighs_by_deviation_and_learns_where_there_is_none() -> None:
    torch.manual_seed(0)
    attention = ContrastAttention(64).double()
    torch.nn.init.ones_(attention.squeeze.bias)  # no unit between the two is dead
    flat = torch.full((1, 64, 6, 6), 0.5, dtype=torch.float64, requires_grad=True)
    attention(flat).sum().backward()
    assert flat.grad is not None and flat.grad.isfinite().all()
    striped = 0.5 + 0.25 * (-1.0) ** torch.arange(6, dtype=torch.float64).expand(1, 64, 6, 6)
    assert not torch.allclose((attention(striped) / striped)[0, :, 0, 0], (attention(flat) / flat)[0, :, 0, 0])


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_is_built_again_from_what_it_says_of_itself(name: str) -> None:
    network = random_network(name, 3)
    again = described_network(network.description)
    again.load_state_dict(network.state_dict())
    clip = random_clip(1, 1, 8, 8)
    assert torch.equal(again.double()(clip)[0].y, network.double()(clip)[0].y)


ARTIFACTS = ("fsrcnn_x2", "fsrcnn_x3", "srvgg_x3", "imdn_x2")


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("peers")
    paths = {title: folder / f"{title}.onnx" for title in ARTIFACTS}
    for title, path in paths.items():
        name, _, scale = title.rpartition("_x")
        network = random_network(name, int(scale))
        with torch.no_grad():  # pictures within the code range, so that clamping hides nothing
            for parameter in list(network.body.children())[-1].parameters():
                parameter.mul_(0.02)
            if name != "srvgg":
                network.body.get_parameter("deconv.bias" if name == "fsrcnn" else "last.bias").fill_(0.5)
        export_network(network, path, name=name, card={"steps": 0})
    return paths


@pytest.mark.parametrize("title", ARTIFACTS)
def test_the_artifact_equals_float64_at_any_size(artifacts: dict[str, Path], title: str) -> None:
    upscaler = OnnxUpscaler(artifacts[title], threads=1)
    scale = upscaler.spec.scale
    for height, width in ((2, 2), (6, 34), (26, 18)):
        clip = random_clip(1, 2, height, width)
        frames = [Frame(*(plane[0, t, 0].to(torch.uint8).numpy() for plane in clip)) for t in range(2)]
        errors = list(parity(artifacts[title], frames, 2))
        assert max(error.max_code_error for error in errors) <= 1
        assert max(error.differing_pixels for error in errors) < 5e-3
        picture, _ = upscaler.step(frames[0], upscaler.initial_state(height, width))
        assert (picture.height, picture.width) == (scale * height, scale * width)
    assert np.mean((picture.y > 0) & (picture.y < 255)) > 0.5


def test_the_artifact_says_what_it_is(artifacts: dict[str, Path]) -> None:
    spec = OnnxUpscaler(artifacts["imdn_x2"], threads=1).spec
    assert (spec.name, spec.scale, spec.size_multiple, spec.precision, spec.state) == ("imdn", 2, 2, "float32", ())
    assert spec.card["network"] == {"architecture": "imdn", "scale": 2}
    assert spec.card["parameters"] == spec.card["parameters_in_training"] == 694_404
    assert spec.card["macs_540p"] == macs(network_of_preset("imdn", 2))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("fsrcnn", 12_464 * 960 * 540),  # every filter weight meets every input pixel once, the deconvolution's too
        ("srvgg", (600_652 - 17 * 2 * 64 - 12) * 960 * 540),  # less biases and slopes
        # less biases: of the stem, the two 1x1 and 3x3 at the end and the last; of a block's four 3x3, fusion and attention
        ("imdn", (694_404 - 3 * 64 - 12 - 6 * (3 * 64 + 16 + 64 + 580)) * 960 * 540 + 6 * 512),
        ("paper", (12 * 32 + 5 * 32 * 32 + 64 * 128 + 32 * 48) * 9 * 480 * 270 + 3 * 3 * 9 * 1920 * 1080),
    ],
)
def test_macs_of_a_540p_frame_by_hand(name: str, expected: int) -> None:
    assert macs(network_of_preset(name, 2).deployed()) == expected


def test_macs_do_not_depend_on_the_form() -> None:
    network = network_of_preset("planes", 2)
    assert macs(network) == macs(network.deployed()) > 0


@pytest.mark.parametrize("name", PEERS)
def test_training_lowers_the_loss_and_its_checkpoint_is_the_network(name: str, tmp_path: Path) -> None:
    footage = write_footage(tmp_path)
    config = TrainConfig(preset=name, degradations=("area",), steps=30, batch=1, patch=16, frames=2, window=2, warm_up_steps=4, halvings=0)
    trainer = Trainer(config, footage, FootageCache(tmp_path / "cache"), tmp_path / "run")
    losses = list(trainer.losses())
    assert np.mean(losses[-6:]) < 0.8 * np.mean(losses[:6])
    trainer.save()
    again = network_of(load_checkpoint(tmp_path / "run" / "checkpoint.pt"))
    for key, weight in trainer.network.state_dict().items():
        assert torch.equal(weight, again.state_dict()[key])
    assert set(trainer.validation(frames=1)["a/four area"]) == {"psnr_y_db", "bicubic_db"}
