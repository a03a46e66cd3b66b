"""FSR 1: equal to its description pixel by pixel, and what must hold of any picture; torch against ONNX Runtime."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from client.frames import Frame
from client.models import find_model
from client.upscaler import OnnxUpscaler
from model.export import Fsr1Baseline, export_baseline
from model.fsr1 import SHARPNESS_STOPS, Easu, Fsr1, rcas
from tests import plain_fsr1

SCALES = pytest.mark.parametrize("scale", [2, 3])


def pictures() -> dict[str, Tensor]:
    """RGB (1, 3, 9, 11) float64 in [0, 1]: noise, a step with a slanted edge, thin lines, black and white, all but flat."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(1, 3, 9, 11, dtype=torch.float64, generator=generator)
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(11.0), indexing="ij")
    colour = torch.tensor([0.9, 0.4, 0.1], dtype=torch.float64)[:, None, None]
    return {
        "noise": noise,
        "edge": (0.1 + colour * (2 * x + y > 12))[None].clamp(0, 1),
        "lines": (colour * (x % 4 == 1) + 0.2 * (y % 3 == 0))[None].clamp(0, 1),
        "black and white": (noise > 0.5).double(),
        "all but flat": 0.5 + noise / 1000,
    }


PICTURES = pytest.mark.parametrize("name", list(pictures()))


def easu(rgb: Tensor, scale: int) -> Tensor:
    found: Tensor = Easu(scale).double()(rgb)
    return found


def plain(picture: Tensor) -> np.ndarray:
    return picture[0].permute(1, 2, 0).numpy()


@PICTURES
@SCALES
def test_easu_is_its_description(name: str, scale: int) -> None:
    rgb = pictures()[name]
    assert np.abs(plain(easu(rgb, scale)) - plain_fsr1.easu(plain(rgb), scale)).max() < 1e-6


@PICTURES
@pytest.mark.parametrize("stops", [0.0, SHARPNESS_STOPS, 1.0])
def test_rcas_is_its_description(name: str, stops: float) -> None:
    rgb = pictures()[name]
    assert np.abs(plain(rcas(rgb, stops)) - plain_fsr1.rcas(plain(rgb), stops)).max() < 1e-6


@SCALES
def test_a_flat_picture_stays_flat(scale: int) -> None:
    for level in (0.0, 0.3, 1.0):
        rgb = torch.full((1, 3, 5, 6), level, dtype=torch.float64)
        enlarged = easu(rgb, scale)
        torch.testing.assert_close(enlarged, torch.full((1, 3, 5 * scale, 6 * scale), level, dtype=torch.float64))
        torch.testing.assert_close(rcas(enlarged, SHARPNESS_STOPS), enlarged)


@PICTURES
@SCALES
def test_easu_stays_between_the_four_nearest(name: str, scale: int) -> None:
    rgb = pictures()[name]
    found = easu(rgb, scale)[0]
    rows, columns = (np.floor((np.arange(scale * side) + 0.5) / scale - 0.5).astype(int) for side in rgb.shape[2:])
    near = torch.stack([rgb[0][:, np.clip(rows + dy, 0, 8)][:, :, np.clip(columns + dx, 0, 10)] for dy in (0, 1) for dx in (0, 1)])
    assert (found >= near.amin(0) - 1e-12).all() and (found <= near.amax(0) + 1e-12).all()


@pytest.mark.parametrize("turn", ["upside down", "mirrored", "transposed"])
@pytest.mark.parametrize("name", ["noise", "edge", "lines", "black and white"])
def test_a_turned_picture_gives_the_turned_picture(name: str, turn: str) -> None:
    """At x2: at x3 every third pixel lies on an input pixel, and the 12 about it reach further to the right and down.

    Nor is it so where a picture is all but flat: FSR then takes any edge for a vertical one.
    """
    rgb = pictures()[name]

    def turned(picture: Tensor) -> Tensor:
        return picture.transpose(2, 3) if turn == "transposed" else picture.flip(2 if turn == "upside down" else 3)

    torch.testing.assert_close(easu(turned(rgb), 2), turned(easu(rgb, 2)))
    torch.testing.assert_close(rcas(turned(rgb), SHARPNESS_STOPS), turned(rcas(rgb, SHARPNESS_STOPS)))


@pytest.mark.parametrize(("scale", "ripple"), [(2, 1e-9), (3, 0.02)])
def test_a_straight_edge_stays_straight(scale: int, ripple: float) -> None:
    """At x3 the pixels that lie on input pixels have their 12 to one side, and the description itself gives a small ripple."""
    for rgb in (torch.zeros(1, 3, 8, 10, dtype=torch.float64), torch.zeros(1, 3, 10, 8, dtype=torch.float64).transpose(2, 3)):
        rgb[..., 5:] = 0.8
        enlarged = easu(rgb, scale)
        assert (enlarged.diff() >= -1e-9).all()
        for picture in (enlarged, rcas(enlarged, SHARPNESS_STOPS)):
            assert (picture - picture[:, :, :1]).abs().max() <= ripple


def test_rcas_sharpens() -> None:
    ramp = torch.tensor([0.2, 0.2, 0.3, 0.5, 0.6, 0.6], dtype=torch.float64).expand(1, 3, 4, 6)
    assert rcas(ramp, SHARPNESS_STOPS)[0, 0, 0].diff().max() > ramp[0, 0, 0].diff().max() * 1.1


def random_frame(height: int, width: int) -> Frame:
    generator = np.random.default_rng(0)
    sizes = (height, width), (height // 2, width // 2), (height // 2, width // 2)
    return Frame(*(generator.integers(0, 256, size, np.uint8) for size in sizes))


@SCALES
@pytest.mark.parametrize("name", ["fsr1", "easu"])
@pytest.mark.parametrize("size", [(2, 2), (2, 6), (18, 26)])
def test_the_shipped_artifact_is_its_float64_reference_at_any_size(name: str, scale: int, size: tuple[int, int]) -> None:
    upscaler = OnnxUpscaler(find_model(name, scale), threads=1)
    frame = random_frame(*size)
    picture, _ = upscaler.step(frame, upscaler.initial_state(*size))
    planes = (torch.from_numpy(plane)[None, None].double() for plane in (frame.y, frame.u, frame.v))
    expected = Fsr1(scale, sharpen=name == "fsr1").double()(*planes)
    for plane, values in zip((picture.y, picture.u, picture.v), expected, strict=True):
        assert np.abs(plane - values[0, 0].clamp(0, 255).numpy()).max() < 0.51


def test_what_is_exported_says_what_it_is(tmp_path: Path) -> None:
    export_baseline("easu", 2, tmp_path / "exported.onnx", name="easu")
    exported, shipped = (OnnxUpscaler(path, threads=1).spec for path in (tmp_path / "exported.onnx", find_model("easu", 2)))
    assert replace(exported, sha256=shipped.sha256) == shipped
    assert (shipped.name, shipped.scale, shipped.state) == ("easu", 2, ())
    assert "is not its time on a GPU" in shipped.card["note"]
    assert b".py" not in (tmp_path / "exported.onnx").read_bytes()  # the exporter's own paths stay at home


@SCALES
def test_chroma_stays_where_it_is(scale: int) -> None:
    """Output chroma column k lies over luma column 2k, which is (2k + 0.5) / scale - 0.5 of the input."""
    ramp = torch.arange(60.0, 160.0, 2).expand(1, 1, 20, 50)
    grey = torch.full((1, 1, 40, 100), 120.0)
    _, u, v = Fsr1Baseline(scale, sharpen=False)(grey, ramp, 220 - ramp)
    columns = torch.arange(6 * scale, 40 * scale)
    place = 60 + 2 * ((2 * columns + 0.5) / scale - 0.5) / 2
    assert (u[0, 0, 8, columns] - place).abs().max() <= 1
    assert (v[0, 0, 8, columns] - (220 - place)).abs().max() <= 1
