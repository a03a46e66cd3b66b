"""Each metric against an independent implementation: naive numpy, scikit-image, and ffmpeg over files."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from client import vmaf
from client.errors import GamesrError, InputError
from client.frames import BT709_LIMITED, ColourTags, Frame, Plane
from client.quality import Quality, QualityMeter, psnr_db, ssim

WIDTH, HEIGHT, FRAMES = 192, 128, 8
Clip = list[Frame]


def scene(index: int, width: int = WIDTH, height: int = HEIGHT) -> Frame:
    """Moving bars and texture: edges for a blur to soften, detail for VMAF to see."""
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    y = 120 + 60 * np.sign(np.sin((columns + 3 * index) / 7)) + 40 * np.sin(rows * columns / 300 + index / 5)
    chroma = [128 + 50 * np.sin((rows[::2, ::2] + k * columns[::2, ::2] + index) / 20) for k in (1, 2)]
    return Frame(*(np.clip(np.rint(plane), 0, 255).astype(np.uint8) for plane in (y, *chroma)))


def with_luma(frame: Frame, luma: np.ndarray) -> Frame:
    return Frame(np.clip(np.rint(luma), 0, 255).astype(np.uint8), frame.u, frame.v)


def blurred(frame: Frame) -> Frame:
    padded = np.pad(frame.y.astype(np.float64), 1, mode="edge")
    rows = (padded[:-2] + padded[1:-1] + padded[2:]) / 3
    return with_luma(frame, (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 3)


def sharpened(frame: Frame, amount: float) -> Frame:
    luma = frame.y.astype(np.float64)
    return with_luma(frame, luma + amount * (luma - blurred(frame).y))


def noisy(frame: Frame, sigma: float, seed: int) -> Frame:
    rng = np.random.default_rng(seed)
    planes = (plane + rng.normal(0, sigma, plane.shape) for plane in (frame.y, frame.u, frame.v))
    return Frame(*(np.clip(np.rint(plane), 0, 255).astype(np.uint8) for plane in planes))


def measure(reference: Clip, distorted: Clip, *, vmaf: bool = False) -> Quality:
    with QualityMeter(reference[0].width, reference[0].height, vmaf=vmaf) as meter:
        for pair in zip(reference, distorted, strict=True):
            meter.add(*pair)
        return meter.result()


@pytest.fixture(scope="module")
def clean() -> Clip:
    return [scene(index) for index in range(FRAMES)]


@pytest.fixture(scope="module")
def soft(clean: Clip) -> Clip:
    return [noisy(blurred(frame), 1 + index, index) for index, frame in enumerate(clean)]


def write_y4m(path: Path, clip: Clip) -> Path:
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{clip[0].width} H{clip[0].height} F60:1 Ip C420mpeg2\n".encode())
        for frame in clip:
            file.write(b"FRAME\n" + frame.y.tobytes() + frame.u.tobytes() + frame.v.tobytes())
    return path


def ffmpeg_compare(folder: Path, reference: Clip, distorted: Clip, graph: str) -> None:
    inputs = ["-i", str(write_y4m(folder / "distorted.y4m", distorted)), "-i", str(write_y4m(folder / "reference.y4m", reference))]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *inputs, "-lavfi", graph, "-f", "null", "-"]
    subprocess.run(command, check=True, cwd=folder)


def test_psnr_is_that_of_the_mean_mse(clean: Clip, soft: Clip) -> None:
    found = measure(clean, soft)
    for name in "yuv":
        errors = [np.mean((getattr(a, name).astype(float) - getattr(b, name).astype(float)) ** 2) for a, b in zip(clean, soft, strict=True)]
        assert getattr(found, f"psnr_{name}_db") == pytest.approx(10 * math.log10(255**2 / np.mean(errors)), abs=1e-9)


def test_psnr_agrees_with_ffmpeg(tmp_path: Path, clean: Clip, soft: Clip) -> None:
    ffmpeg_compare(tmp_path, clean, soft, "psnr=stats_file=psnr.log")
    mse = {
        name: float(np.mean([float(m) for m in re.findall(rf"mse_{name}:([\d.]+)", (tmp_path / "psnr.log").read_text())])) for name in "yuv"
    }
    found = measure(clean, soft)
    assert [found.psnr_y_db, found.psnr_u_db, found.psnr_v_db] == pytest.approx([psnr_db(mse[name]) for name in "yuv"], abs=1e-3)


@pytest.mark.parametrize(("width", "height"), [(192, 128), (107, 61), (27, 26), (11, 11), (12, 37), (1280, 11)])
def test_ssim_agrees_with_scikit_image(width: int, height: int) -> None:
    a = scene(3, width, height)
    b = noisy(blurred(a), 5, 1)
    theirs = structural_similarity(a.y, b.y, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255)
    assert ssim(a.y, b.y) == pytest.approx(theirs, abs=1e-9)


def test_ssim_of_flat_pictures_is_exact() -> None:
    a, b = np.full((40, 50), 200, np.uint8), np.full((40, 50), 210, np.uint8)
    assert ssim(a, b) == pytest.approx((2 * 200 * 210 + 6.5025) / (200**2 + 210**2 + 6.5025), abs=1e-12)


def test_temporal_error_is_the_rms_difference_of_the_frame_differences(clean: Clip, soft: Clip) -> None:
    ours, theirs = (np.diff([frame.y.astype(float) for frame in clip], axis=0) for clip in (soft, clean))
    assert measure(clean, soft).temporal_error == pytest.approx(math.sqrt(np.mean((ours - theirs) ** 2)), abs=1e-9)


def test_temporal_error_sees_flicker_and_not_a_constant_error(clean: Clip) -> None:
    brighter = [with_luma(frame, frame.y + 4.0) for frame in clean]
    flickering = [with_luma(frame, frame.y + (4.0 if index % 2 else -4.0)) for index, frame in enumerate(clean)]
    steady, flicker = measure(clean, brighter), measure(clean, flickering)
    assert steady.psnr_y_db == pytest.approx(flicker.psnr_y_db, abs=1e-9)
    assert (steady.temporal_error, flicker.temporal_error) == pytest.approx((0, 8))
    blur, noise = measure(clean, [blurred(frame) for frame in clean]), measure(clean, [noisy(f, 12, i) for i, f in enumerate(clean)])
    assert blur.psnr_y_db is not None and noise.psnr_y_db is not None
    assert blur.temporal_error is not None and noise.temporal_error is not None
    assert blur.psnr_y_db < noise.psnr_y_db and 0 < blur.temporal_error < noise.temporal_error * 1.5


@pytest.mark.parametrize("kind", ["flicker", "blur", "noise"])
def test_temporal_error_rises_with_flicker_with_noise_and_with_a_blur_of_what_moves(clean: Clip, kind: str) -> None:
    def worsened(index: int, frame: Frame, strength: int) -> Frame:
        if kind == "noise":
            return noisy(frame, 2.0 * strength, index)
        if kind == "flicker":
            return with_luma(frame, frame.y + 2.0 * strength * (-1) ** index)
        for _ in range(strength):
            frame = blurred(frame)
        return frame

    moving, still = (
        [measure(clip, [worsened(i, f, strength) for i, f in enumerate(clip)]).temporal_error or 0 for strength in (1, 2, 4)]
        for clip in (clean, [clean[0]] * FRAMES)
    )
    assert 0 < moving[0] < moving[1] < moving[2]
    assert still == [0, 0, 0] if kind == "blur" else 0 < still[0] < still[1] < still[2]


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (107, 61)])
def test_vmaf_agrees_with_a_plain_run_over_two_files(tmp_path: Path, size: tuple[int, int]) -> None:
    clean = [scene(index, *size) for index in range(FRAMES)]
    soft = [blurred(frame) for frame in clean]
    found = measure(clean, soft, vmaf=True)
    for name, model in (("vmaf", "vmaf_v0.6.1"), ("vmaf_neg", "vmaf_v0.6.1neg")):
        sync = "settb=AVTB,setpts=N/60/TB"
        graph = f"[0:v]{sync}[a];[1:v]{sync}[b];[a][b]libvmaf=model=version={model}:log_fmt=json:log_path={name}.json"
        ffmpeg_compare(tmp_path, clean, soft, graph)
        pooled = json.loads((tmp_path / f"{name}.json").read_text())["pooled_metrics"]["vmaf"]
        assert getattr(found, name) == pytest.approx(pooled["mean"], abs=1e-4)
        assert getattr(found, f"{name}_harmonic_mean") == pytest.approx(pooled["harmonic_mean"], abs=1e-4)
        assert pooled["min"] <= getattr(found, f"{name}_p5") <= pooled["mean"]


def test_vmaf_falls_with_blur_and_sharpening_past_the_reference_buys_more_vmaf_than_neg(clean: Clip) -> None:
    soft = [blurred(blurred(frame)) for frame in clean]
    same, plain, sharp = (measure(clean, clip, vmaf=True) for clip in (clean, soft, [sharpened(frame, 5) for frame in soft]))
    assert same.vmaf is not None and plain.vmaf is not None and sharp.vmaf is not None
    assert plain.vmaf_neg is not None and sharp.vmaf_neg is not None
    assert same.vmaf > plain.vmaf + 5
    assert sharp.vmaf - plain.vmaf > sharp.vmaf_neg - plain.vmaf_neg + 5


def test_identical_clips_are_said_to_be_identical(clean: Clip) -> None:
    found = measure(clean, clean)
    assert (found.psnr_y_db, found.psnr_u_db, found.psnr_v_db) == (None, None, None)
    assert found.undefined["psnr_y_db"] == "identical"
    assert found.ssim_y == pytest.approx(1, abs=1e-12) and found.temporal_error == 0
    assert json.loads(json.dumps(found.record(), allow_nan=False))["frames"] == FRAMES


def test_every_undefined_figure_has_its_reason() -> None:
    tiny = [scene(0, 3, 5)]
    for found in (measure(tiny, tiny, vmaf=True), QualityMeter(64, 64, vmaf=False).result()):
        record = found.record()
        assert {name for name, value in record.items() if value is None} == set(found.undefined)
    assert "11x11" in measure(tiny, tiny).undefined["ssim_y"] and "32x32" in measure(tiny, tiny, vmaf=True).undefined["vmaf"]


def test_without_the_extra_vmaf_is_none_and_says_so(monkeypatch: pytest.MonkeyPatch, clean: Clip, soft: Clip) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    found = measure(clean, soft, vmaf=True)
    assert found.vmaf is None and "metrics" in found.undefined["vmaf"] and found.psnr_y_db is not None


def test_an_ffmpeg_without_libvmaf_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(vmaf, "_ffmpeg", lambda: sys.executable)
    assert vmaf.why_unavailable(64, 64) == f"{sys.executable} has no libvmaf"


def test_a_failing_ffmpeg_is_one_sentence_and_leaves_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, clean: Clip) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setitem(vmaf.MODELS, "vmaf", "no_such_model")
    with pytest.raises(GamesrError, match=r"^VMAF: ffmpeg stopped: .+") as caught, QualityMeter(WIDTH, HEIGHT) as meter:
        for frame in clean * 20:
            meter.add(frame, frame)
        meter.result()
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_an_abandoned_measurement_ends_its_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, clean: Clip) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(KeyboardInterrupt), vmaf.VmafRun(WIDTH, HEIGHT) as run:
        run.add(clean[0], clean[0])
        raise KeyboardInterrupt
    assert run._process.poll() is not None and not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="over"):
        run.add(clean[0], clean[0])


def test_another_size_is_refused_by_name() -> None:
    with QualityMeter(64, 48, vmaf=False) as meter, pytest.raises(InputError, match="frame 0 of the measured clip is 64x50 where 64x48"):
        meter.add(scene(0, 64, 48), scene(0, 64, 50))


def test_another_colour_coding_is_refused_and_an_unknown_one_is_not() -> None:
    frame = scene(0, 64, 48)
    planes = (frame.y, frame.u, frame.v)
    with QualityMeter(64, 48, vmaf=False) as meter:
        meter.add(Frame(*planes, colour=ColourTags()), frame)
        for other in (ColourTags(range=2), ColourTags(matrix=6)):
            with pytest.raises(InputError, match="colour coding"):
                meter.add(Frame(*planes, colour=other), Frame(*planes, colour=BT709_LIMITED))


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_metrics_are_symmetric_and_blind_to_strides(width: int, height: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (random_clip(rng, width, height) for _ in range(2))
    there, back, strided = measure(a, b), measure(b, a), measure([apart(f) for f in a], b)
    assert there == strided
    assert (there.psnr_y_db, there.psnr_u_db, there.temporal_error) == (back.psnr_y_db, back.psnr_u_db, back.temporal_error)
    assert there.ssim_y == (back.ssim_y if back.ssim_y is None else pytest.approx(back.ssim_y, abs=1e-12))


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_more_noise_is_worse(seed: int) -> None:
    frame = scene(0, 64, 64)
    ladder = [measure([frame, frame], [noisy(frame, sigma, seed), noisy(frame, sigma, seed + 1)]) for sigma in (2, 5, 12)]
    for name, sign in (("psnr_y_db", -1), ("psnr_v_db", -1), ("ssim_y", -1), ("temporal_error", 1)):
        values = [sign * getattr(found, name) for found in ladder]
        assert values == sorted(values), name


def random_clip(rng: np.random.Generator, width: int, height: int) -> Clip:
    chroma = (-(-height // 2), -(-width // 2))
    return [Frame(*(rng.integers(0, 256, shape, np.uint8) for shape in ((height, width), chroma, chroma))) for _ in range(2)]


def apart(frame: Frame) -> Frame:
    def spread(plane: Plane) -> Plane:
        wide = np.zeros((plane.shape[0], plane.shape[1] + 13), np.uint8)
        wide[:, : plane.shape[1]] = plane
        return wide[:, : plane.shape[1]]

    return Frame(spread(frame.y), spread(frame.u), spread(frame.v))
