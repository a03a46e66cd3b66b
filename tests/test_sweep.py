"""The sweep: what a point is, what it depends on, and that a store has every point once whatever happens to the process."""

from __future__ import annotations

import json
import shutil
import weakref
from collections.abc import Callable, Generator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import server.job
from client.cloud import CloudEncoder, CloudSettings, area_downscale, through_codec
from client.frames import Frame
from client.models import find_model
from client.quality import Quality, QualityMeter
from client.upscaler import OnnxUpscaler
from client.video import read_frames
from server.encoding import clip_frames
from server.events import LatencyDone, LatencyReused, PlanMade, PointDone, PointFailed, PointReused, Waiting, event_record
from server.latency import latency_key
from server.points import Flag, Point, PointResult
from server.store import Store
from server.sweep import run_sweep
from server.workers import LocalWorkers
from tests.sweeping import done, plan_of, results, some_latency, sweep_here

SIZE = {"width": 96, "height": 72}


@pytest.fixture
def clip(make_clip: Callable[..., Path]) -> Path:
    return make_clip("clip.mkv", **SIZE)


def measured_by_hand(clip: Path, scale: int, upscaler: str | None, settings: CloudSettings) -> Quality:
    reference = list(read_frames(clip))
    low = (frame if scale == 1 else area_downscale(frame, scale) for frame in reference)
    model = OnnxUpscaler(find_model(upscaler, scale), threads=1) if upscaler else None
    with QualityMeter(reference[0].width, reference[0].height) as meter:
        state = model.initial_state(reference[0].height // scale, reference[0].width // scale) if model else None
        for original, picture in zip(reference, through_codec(low, settings), strict=True):
            if model and state:
                picture, state = model.step(picture, state)
            meter.add(original, picture)
        return meter.result()


def test_every_point_is_what_the_same_steps_give_by_hand(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="none,bicubic,lanczos")
    with Store(tmp_path / "store") as store:
        events = list(run_sweep(plan, store, LocalWorkers(2)))
    assert events[0] == PlanMade(points=10, latencies=0, workers=2)
    found = results(events)
    assert set(found) == {point.key for point in plan.points}
    assert {(p.low_height, p.upscaler) for p in plan.points} == {(72, "none")} | {(h, u) for h in (36, 24) for u in ("bicubic", "lanczos")}
    for result in found.values():
        point = result.point
        upscaler = None if point.upscaler == "none" else point.upscaler
        assert result.quality == measured_by_hand(clip, point.scale, upscaler, CloudSettings(point.requested_kbps, 30))
        assert result.quality.frames == 12 and result.quality.vmaf is not None and result.quality.vmaf_neg_p5 is not None
        assert result.lpips is None and "--lpips" in str(result.lpips_undefined)
    assert done(events).done == 10 and (done(events).overhead or 0) > 0


def test_a_second_sweep_computes_nothing(clip: Path, tmp_path: Path) -> None:
    plan = plan_of(clip, upscalers="bicubic", heights=[36])
    first, second = (sweep_here(plan, tmp_path / "store") for _ in range(2))
    assert results(first) == results(second)
    assert not any(isinstance(event, PointDone) for event in second) and done(second).reused == 2 and done(second).overhead is None
    wider = sweep_here(plan_of(clip, upscalers="bicubic,lanczos", heights=[36]), tmp_path / "store")
    assert (done(wider).done, done(wider).reused) == (2, 2)


def test_what_is_reused_has_the_names_of_who_asks(clip: Path, tmp_path: Path) -> None:
    sweep_here(plan_of(clip, heights=[36], bitrates=[200]), tmp_path / "store")
    renamed = clip.rename(tmp_path / "renamed.mkv")
    mine = shutil.copy(find_model("bicubic", 2), tmp_path / "mine.onnx")
    plan = plan_of(renamed, upscalers=f"none,{mine}", heights=[36], bitrates=[200], latency=True)
    with Store(tmp_path / "store") as store:
        for ask in (ask for job in plan.latency_jobs for ask in job.asks):
            store.keep_latency(latency_key(ask), some_latency())
    events = sweep_here(plan, tmp_path / "store")
    points = [event.result.point for event in events if isinstance(event, PointReused)]
    latencies = [event.result for event in events if isinstance(event, LatencyReused)]
    for found in (points, latencies):
        assert sorted((of.clip, of.upscaler) for of in found) == [("renamed", "mine"), ("renamed", "none")]


def test_the_key_depends_on_every_input_and_on_no_name() -> None:
    point = Point("c", "a", 64, 48, 30, None, 24, None, 200, {"threads": 1}, "u", "b", {"av": "1"})
    others = {
        "clip_sha256": "x",
        "width": 66,
        "height": 50,
        "fps": 60,
        "frames": 3,
        "low_height": 16,
        "low_sha256": "x",
        "requested_kbps": 201,
        "encoder": {"threads": 2},
        "upscaler_sha256": None,
        "versions": {"av": "2"},
    }
    assert set(others) | {"clip", "upscaler"} == {field.name for field in fields(Point)}
    assert len({point.key} | {replace(point, **{name: value}).key for name, value in others.items()}) == len(others) + 1
    assert replace(point, clip="other", upscaler="other").key == point.key


def test_an_encoders_setting_a_clips_byte_and_an_artifact_are_in_the_key(
    clip: Path, make_clip: Callable[..., Path], model_file: Callable[..., Path]
) -> None:
    def keys(path: Path, **more: object) -> set[str]:
        return {point.key for point in plan_of(path, heights=[36], bitrates=[200], **more).points}

    plain = keys(clip, upscalers="bicubic")
    for other in (keys(make_clip("b.mkv", frames=11, **SIZE), upscalers="bicubic"), keys(clip, upscalers="bicubic", frames=5)):
        assert not plain & other
    one, two = (str(model_file(f"{gain}.onnx", gain=gain)) for gain in (0.5, 0.25))
    assert len(keys(clip, upscalers=one) | keys(clip, upscalers=two) | plain) == 3


def test_an_unreachable_bitrate_is_flagged_on_the_point(clip: Path, tmp_path: Path) -> None:
    found = results(sweep_here(plan_of(clip, upscalers="none", heights=[72], bitrates=[1, 100_000]), tmp_path / "store"))
    flags = {result.point.requested_kbps: result.flags for result in found.values()}
    assert flags == {1: (Flag.ABOVE,), 100_000: (Flag.BELOW,)}
    assert f"more than {server.job.TOLERANCE:.0%} below the bitrate that was asked for" in Flag.BELOW.value
    for result in found.values():
        assert PointResult.from_record(json.loads(json.dumps(result.record()))) == result


def test_the_bitrate_is_counted_from_packets(clip: Path, tmp_path: Path) -> None:
    (result,) = results(sweep_here(plan_of(clip, upscalers="bicubic", heights=[36], bitrates=[200]), tmp_path / "store")).values()
    encoder = CloudEncoder(CloudSettings(200, 30), 48, 36)
    packets = [packet for frame in read_frames(clip) for packet in encoder.encode(area_downscale(frame, 2))] + encoder.flush()
    assert result.bitrate_kbps == pytest.approx(sum(map(len, packets)) * 8 * 30 / 12 / 1000)


def test_a_lower_rate_takes_whole_frames_out(clip: Path, tmp_path: Path) -> None:
    events = sweep_here(plan_of(clip, upscalers="bicubic", heights=[36], bitrates=[200], fps=15, frames=4), tmp_path / "store")
    (result,) = results(events).values()
    assert result.quality.frames == 4 and result.point.fps == 15 and result.point.encoder["fps"] == 15


def test_a_clip_rendered_small_takes_the_place_of_downscaling(clip: Path, make_clip: Callable[..., Path], tmp_path: Path) -> None:
    small = make_clip("small.mkv", width=48, height=36)
    plain, rendered = (
        plan_of(clip, upscalers="bicubic", heights=[36, 24], bitrates=[200], renders=renders) for renders in ([], [(clip, small)])
    )
    assert {p.low_height for p in rendered.points if p.low_sha256} == {36}
    first, second = (results(sweep_here(plan, tmp_path / "store")) for plan in (plain, rendered))
    assert len(first.keys() & second.keys()) == 1 and len(first | second) == 3
    (one, other) = ([r.quality.psnr_y_db for r in found.values() if r.point.low_height == 36] for found in (first, second))
    assert one != other


@pytest.mark.parametrize("tags", [(2, 1, 1, 1), (1, 6, 6, 6), (0, 2, 2, 2)])
def test_any_colour_coding_is_measured_in_its_own_codes(make_clip: Callable[..., Path], tmp_path: Path, tags: tuple[int, ...]) -> None:
    path = make_clip("tagged.mkv", tags=tags, **SIZE)
    events = sweep_here(plan_of(path, upscalers="none,bicubic", heights=[36], bitrates=[400]), tmp_path / "store")
    assert all((result.quality.psnr_y_db or 0) > 20 for result in results(events).values()) and done(events).failed == 0


def test_memory_does_not_grow_with_the_clip(make_clip: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alive, most = 0, 0

    def died() -> None:
        nonlocal alive
        alive -= 1

    def counted(path: Path, step: int, limit: int | None) -> Generator[Frame]:
        nonlocal alive, most
        for frame in clip_frames(path, step, limit):
            luma = frame.y.copy()
            weakref.finalize(luma, died)
            alive += 1
            most = max(most, alive)
            yield replace(frame, y=luma)
            del frame, luma

    monkeypatch.setattr(server.job, "clip_frames", counted)
    plan = plan_of(make_clip("long.mkv", frames=60, **SIZE), upscalers="none,bicubic", heights=[36], bitrates=[400])
    assert done(sweep_here(plan, tmp_path / "store")).done == 2
    assert 0 < most <= 4


def test_one_damaged_clip_does_not_take_the_others_with_it(clip: Path, make_clip: Callable[..., Path], tmp_path: Path) -> None:
    broken = make_clip("broken.mkv", frames=40, **SIZE)
    content = bytearray(broken.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 300] = bytes(300)
    broken.write_bytes(content)
    events = sweep_here(plan_of(clip, broken, upscalers="none,bicubic", heights=[36], bitrates=[400]), tmp_path / "store")
    failures = [event for event in events if isinstance(event, PointFailed)]
    assert {failure.point.clip for failure in failures} == {"broken"} and all("damaged" in failure.reason for failure in failures)
    assert {result.point.clip for result in results(events).values()} == {"clip"} and done(events).failed == len(failures) == 2
    assert "Traceback" in failures[0].trace


def test_a_file_that_changes_after_planning_fails_its_points(
    clip: Path, make_clip: Callable[..., Path], model_file: Callable[..., Path], tmp_path: Path
) -> None:
    model = model_file("mine.onnx")
    plan = plan_of(clip, upscalers=f"bicubic,{model}", heights=[36], bitrates=[400])
    model_file("mine.onnx", gain=0.25)
    events = sweep_here(plan, tmp_path / "store")
    assert [event.reason for event in events if isinstance(event, PointFailed)] == [
        f"{model} is not the file that was planned with: it changed, or is another one on this machine"
    ]
    make_clip("clip.mkv", frames=10, **SIZE)
    assert done(sweep_here(plan, tmp_path / "other")).failed == 2


def test_other_versions_than_those_planned_with_are_not_measured_with(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_of(clip, upscalers="bicubic", heights=[36], bitrates=[400])
    monkeypatch.setattr("server.versions.av.__version__", "0")
    (failed,) = (event for event in sweep_here(plan, tmp_path / "store") if isinstance(event, PointFailed))
    assert failed.reason.startswith("av is 0 on this machine")


def test_no_space_for_working_files_is_a_sentence_on_the_point(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("server.encoding.tempfile.TemporaryFile", full)
    events = sweep_here(plan_of(clip, heights=[36]), tmp_path / "store")
    assert {event.reason for event in events if isinstance(event, PointFailed)} == {
        "working files cannot be written: No space left on device"
    }


def test_every_event_is_a_line_of_json(clip: Path, tmp_path: Path) -> None:
    events = [*sweep_here(plan_of(clip, heights=[36], bitrates=[200]), tmp_path / "store"), LatencyDone(some_latency())]
    events += [PointFailed(results(events)[next(iter(results(events)))].point, "why", "where"), Waiting("why")]
    kinds = [json.loads(json.dumps(event_record(event), allow_nan=False))["event"] for event in events]
    assert kinds == ["plan_made", "point_done", "point_done", "sweep_done", "latency_done", "point_failed", "waiting"]


def test_a_picture_is_upscaled_by_the_pipeline_of_the_users(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    pipeline = server.job.upscale_stream

    def spied(*arguments: object) -> object:
        seen.append(arguments)
        return pipeline(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(server.job, "upscale_stream", spied)
    sweep_here(plan_of(clip, upscalers="none,bicubic", heights=[36], bitrates=[200]), tmp_path / "store")
    assert len(seen) == 1 and np.shape(seen) == (1, 3)


@pytest.mark.parametrize("scale", [2, 16, 17, 30])
def test_a_flat_picture_stays_what_it_is_by_any_scale(scale: int) -> None:
    """The largest blocks come to sums that 16 bits do not hold."""
    side = 4 * scale
    small = area_downscale(Frame(*(np.full((n, n), 255, np.uint8) for n in (side, side // 2, side // 2))), scale)
    assert [set(plane.ravel()) for plane in (small.y, small.u, small.v)] == [{255}] * 3
