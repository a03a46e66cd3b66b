"""Training: footage lists, degradation, sampling, and what a run needs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from client.cloud import CloudEncoder, CloudSettings, area_downscale, through_codec
from client.errors import InputError
from client.frames import Frame, plane_shapes
from model.cli import train_main
from model.export_cli import main as export_main
from model.footage import Degradation, FootageCache, load_pairs, load_scenes
from model.losses import LOSSES, mean_log_mse
from model.planes import Planes
from model.sampling import by_game, sample_clips
from model.train import TrainConfig, Trainer, load_checkpoint, network_of
from tests.moving import picture, scene, write_footage


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_footage(tmp_path_factory.mktemp("footage"))


TINY = TrainConfig(degradations=("area", "area@300"), steps=8, batch=2, patch=16, frames=4, window=2, warm_up_steps=2)


def test_the_psnr_loss_is_psnr_yuv_of_the_clips_turned_round() -> None:
    random = np.random.default_rng(0)
    shapes = ((3, 2, 1, 8, 12), (3, 2, 1, 4, 6), (3, 2, 1, 4, 6))
    target = [random.uniform(0, 255, shape) for shape in shapes]
    output = [plane + random.normal(0, 3 + n, plane.shape) for n, plane in enumerate(target)]
    y, u, v = (10 * np.log10(255**2 / np.square(a - b).mean((1, 2, 3, 4))) for a, b in zip(output, target, strict=True))
    psnr_yuv = np.mean((6 * y + u + v) / 8)
    loss = mean_log_mse(*(Planes(*map(torch.from_numpy, planes)) for planes in (output, target)))
    assert 10 * math.log10(255**2) - 10 / math.log(10) * loss.item() == pytest.approx(psnr_yuv, abs=0.05)  # but for the floor


def test_the_losses_train_different_weights_and_no_other_is_taken(footage: Path, tmp_path: Path) -> None:
    cache = FootageCache(tmp_path / "cache")
    trainers = [Trainer(TrainConfig(**{**TINY.__dict__, "loss": loss}), footage, cache, tmp_path / loss) for loss in LOSSES]
    for trainer in trainers:
        assert all(map(np.isfinite, trainer.losses()))
    assert not torch.equal(*(trainer.network.head.weight for trainer in trainers))
    with pytest.raises(InputError, match="no loss is called 'ssim': there are charbonnier, psnr"):
        TrainConfig(loss="ssim")


def test_a_run_may_start_from_the_weights_of_another_scale(footage: Path, tmp_path: Path) -> None:
    cache = FootageCache(tmp_path / "cache")
    first = Trainer(TINY, footage, cache, tmp_path / "two")
    first.run(validate_every=100, progress=False)
    weights = str(tmp_path / "two" / "checkpoint.pt")
    second = Trainer(TrainConfig(**{**TINY.__dict__, "scale": 3, "initial_weights": weights}), footage, cache, tmp_path / "three")
    assert torch.equal(second.network.stem.weight, first.network.stem.weight)
    assert second.network.head.weight.shape != first.network.head.weight.shape


def test_training_lowers_the_loss_and_another_seed_is_another_run(footage: Path, tmp_path: Path) -> None:
    config = TrainConfig(degradations=("area",), steps=60, batch=2, patch=32, frames=4, window=2, warm_up_steps=5)
    cache = FootageCache(tmp_path / "cache")
    losses = list(Trainer(config, footage, cache, tmp_path / "a").losses())
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])
    odd = Trainer(TrainConfig(**{**TINY.__dict__, "steps": 3}), footage, cache, tmp_path / "odd")
    assert len(list(odd.losses())) == odd.step == 3  # not a whole number of clips
    other = Trainer(TrainConfig(**{**TINY.__dict__, "seed": 1}), footage, cache, tmp_path / "b")
    assert next(other.losses()) != losses[0]


def test_the_command_trains_logs_and_refuses_another_configuration(
    footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    tiny = ["--steps", "4", "--batch", "2", "--patch", "16", "--frames", "4", "--window", "2", "--degradations", "area"]
    command = [str(footage), str(run), "--cache", str(tmp_path / "cache"), *tiny]
    assert train_main(command) == 0
    row = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    assert row["step"] == 4
    assert set(row["held_out"]) == {"a/four area"}
    assert train_main([*command, "--seed", "3"]) == 1
    assert "another configuration (seed)" in capsys.readouterr().err
    network_of(load_checkpoint(run / "checkpoint.pt"))


def test_an_identical_picture_has_no_psnr_in_the_log_and_on_the_page(footage: Path, make_clip: Callable[..., Path], tmp_path: Path) -> None:
    """A film that begins black is as black by bicubic."""
    black = Frame(*(np.full(shape, level, np.uint8) for shape, level in zip(plane_shapes(72, 96), (16, 128, 128), strict=True)))
    make_clip("dark.mkv", width=96, height=72, pictures=[black] * 12)
    films = scene("one", "a", "train", str(footage.with_name("clip.mkv"))) + scene("dark", "a", "validate", "dark.mkv")
    (tmp_path / "footage.toml").write_text(films)
    tiny = ["--steps", "4", "--batch", "2", "--patch", "16", "--frames", "4", "--window", "2", "--degradations", "area"]
    assert train_main([str(tmp_path / "footage.toml"), str(tmp_path / "run"), "--cache", str(tmp_path / "cache"), *tiny]) == 0
    (row,) = (json.loads(line, parse_constant=pytest.fail) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines())
    assert row["held_out"]["a/dark area"]["bicubic_db"] is None
    assert export_main([str(tmp_path / "run" / "checkpoint.pt"), "mine", "--folder", str(tmp_path)]) == 0
    page = (tmp_path / "mine_x2.md").read_text()
    assert "| a/dark area | identical | " in page and " | undefined |\n" in page


@pytest.mark.parametrize("rate", ["-1", "0", "nan", "inf"])
def test_a_learning_rate_that_is_none_is_refused(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], rate: str) -> None:
    command = [str(footage), str(tmp_path / "run"), "--cache", str(tmp_path / "cache"), "--learning-rate", rate]
    assert train_main(command) == 1
    assert capsys.readouterr().err == f"gamesr-train: the learning rate is a number above 0, not {float(rate)}\n"


@pytest.mark.parametrize("device", ["foo", "meta", "cuda:99"])
def test_a_device_that_is_not_there_is_refused(footage: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], device: str) -> None:
    assert train_main([str(footage), str(tmp_path / "run"), "--cache", str(tmp_path / "cache"), "--device", device]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"gamesr-train: torch cannot compute on the device {device!r}: ") and said.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"patch": 64}, "a/one area is 72x48 at 1/2, smaller than a patch of 64"),
        ({"frames": 14}, "a/one area is shorter than a clip of 14 frames"),
        ({"degradations": ("native",)}, "no validate scene of .* was rendered for native"),
        ({"degradations": ("area:aa", "area:aa")}, "no train scene of .* was rendered for area:aa$"),
    ],
)
def test_footage_that_does_not_suffice_is_refused_before_training(
    footage: Path, tmp_path: Path, change: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        Trainer(TrainConfig(**{**TINY.__dict__, **change}), footage, FootageCache(tmp_path / "cache"), tmp_path / "run")


def test_what_cannot_be_written_to_its_end_leaves_nothing(footage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    def full_after(state: object, path: Path) -> None:
        path.write_bytes(b"half")
        full()

    cache = FootageCache(tmp_path / "cache")
    trainer = Trainer(TINY, footage, cache, tmp_path / "run")
    kept = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(torch, "save", full_after)
    monkeypatch.setattr(np.lib.format, "write_array_header_1_0", full)
    for write in (trainer.save, lambda: cache.degraded(load_scenes(footage, split="test")[0], 3, Degradation("area"))):
        with pytest.raises(OSError, match="No space"):
            write()
    assert sorted(tmp_path.rglob("*")) == kept


def test_a_batch_is_a_function_of_seed_and_index(footage: Path, tmp_path: Path) -> None:
    pairs = load_pairs(load_scenes(footage, split="train"), FootageCache(tmp_path), 2, [Degradation("area")])
    games = by_game(pairs)
    assert [len(scenes) for scenes in games] == [1, 2]
    first, again, other = (sample_clips(games, seed=0, index=i, batch=3, frames=4, patch=16, scale=2) for i in (5, 5, 6))
    assert [p.shape for p in first[0]] == [(3, 4, 1, 16, 16), (3, 4, 1, 8, 8), (3, 4, 1, 8, 8)]
    assert [p.shape for p in first[1]] == [(3, 4, 1, 32, 32), (3, 4, 1, 16, 16), (3, 4, 1, 16, 16)]
    assert all(np.array_equal(a, b) for a, b in zip(first[0] + first[1], again[0] + again[1], strict=True))
    assert not np.array_equal(first[0][0], other[0][0])
    # the crops of the two sizes show the same place: one is the other's area mean, to its rounding
    mean = first[1][0].reshape(3, 4, 1, 16, 2, 16, 2).mean((4, 6))
    assert np.abs(mean - first[0][0]).max() <= 0.5


def test_a_native_render_stands_in_for_the_downscaled_picture(footage: Path, tmp_path: Path) -> None:
    scenes = load_scenes(footage, split="train")
    pairs = load_pairs(scenes, FootageCache(tmp_path), 2, [Degradation("native"), Degradation("native", 300)])
    assert [[pair.title for pair in takes] for takes in pairs] == [["a/one native", "a/one native@300"]]  # the others have none
    clean, encoded = pairs[0]
    rendered, downscaled = picture(3, 48, 72).y.astype(int), area_downscale(picture(3), 2).y
    assert np.abs(clean.low.frame(3).y - rendered).mean() < 2 < np.abs(clean.low.frame(3).y - downscaled.astype(int)).mean()
    assert not np.array_equal(encoded.low.frame(3).y, clean.low.frame(3).y)
    with pytest.raises(InputError, match="no native 32p render"):
        FootageCache(tmp_path).degraded(scenes[0], 3, Degradation("native"))


@pytest.mark.parametrize("scale", [2, 3])
def test_area_downscale_keeps_means_and_the_place_of_chroma(scale: int) -> None:
    frame = picture(0, 48, 96)
    small = area_downscale(frame, scale)
    expected = frame.y.reshape(48 // scale, scale, 96 // scale, scale).mean((1, 3))
    assert np.abs(expected - small.y).max() <= 0.5
    # on a ramp over chroma columns, output column j lies at input column scale * j + (scale - 1) / 4
    ramp = np.tile(np.arange(0, 192, 4, dtype=np.uint8), (24, 1))
    moved = area_downscale(Frame(frame.y, ramp, ramp), scale).u[:, 1:-1]
    place = scale * np.arange(1, moved.shape[1] + 1) + (scale - 1) / 4
    assert np.abs(moved - 4 * place).max() <= 0.5
    with pytest.raises(ValueError, match="not a multiple"):
        area_downscale(picture(0, 46, 96), 2 * scale)


def test_the_codec_gives_every_frame_and_the_bitrate_decides_how_well() -> None:
    frames = [picture(t) for t in range(10)]
    errors = []
    for bitrate_kbps in (50, 2000):
        decoded = list(through_codec(frames, CloudSettings(bitrate_kbps, 30)))
        assert len(decoded) == len(frames)
        errors.append(np.mean([np.square(a.y.astype(float) - b.y).mean() for a, b in zip(frames, decoded, strict=True)]))
    assert errors[0] > 4 * errors[1]


def test_the_cloud_encoder_holds_nothing_back() -> None:
    encoder = CloudEncoder(CloudSettings(500, 30), 144, 96)
    assert [len(encoder.encode(picture(t))) for t in range(40)] == [1] * 40
    assert encoder.flush() == []


@pytest.mark.parametrize("text", ["box", "area@", "area@x", "native@0", "area@-1", "", "area:", "area@²", "area@٣", "area@" + "9" * 5000])
def test_an_unknown_degradation_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="not a degradation"):
        Degradation.parse(text)


def test_a_degradation_is_read_as_it_is_written() -> None:
    texts = ["area", "native@4000", "area:aa", "native:aa@1"]
    assert [str(Degradation.parse(text)) for text in texts] == texts


SCENE = '[[scene]]\nname="a"\ngame="g"\nsplit="train"\nfps=30\nreference="x"\n'


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("scene = 3", "not a footage list"),
        ("[[scene]]\nname='a'", "not a footage list"),
        ("not toml", "not a footage list"),
        (
            '[[scene]]\nname="a"\ngame="g"\nsplit="train"\nfps=30\nreference="x"\n' * 2
            + '[[scene]]\nname="a"\ngame="g"\nsplit="test"\nfps=30\nreference="x"',
            "two splits",
        ),
        ('[[scene]]\nname="a"\ngame="g"\nsplit="test"\nfps=30\nreference="x"', "no train scene"),
        (SCENE.replace("30", "0"), "fps is a whole number from 1 to 1000, not 0"),
        (SCENE.replace("30", '"30"'), "fps is a whole number"),
        (SCENE.replace("30", "true"), "fps is a whole number"),
        (SCENE.replace('"g"', '["g"]'), "is not a text"),
        (SCENE.replace('"a"', '"a b"'), "has a space in it"),
        (SCENE + 'native=["x"]', "native has files by height"),
        (SCENE + "native={540=3}", "is not a text"),
        (SCENE + "antialiased=3", "is not a text"),
        ("scene = " + "[" * 5000, "not a footage list"),
    ],
)
def test_a_bad_footage_list_is_refused(tmp_path: Path, content: str, reason: str) -> None:
    (tmp_path / "footage.toml").write_text(content)
    with pytest.raises(InputError, match=reason):
        load_scenes(tmp_path / "footage.toml", split="train")
