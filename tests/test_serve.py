"""What the service answers: the store's results, the figures that the same functions give by hand, and no more than it should."""

from __future__ import annotations

import hmac
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from client.models import shipped_models
from server import guards
from server.asked import AskedSweep
from server.bdrate import Figure, Undefined, bitrate_at, saving
from server.curves import METRICS, anchors, compare, series_by_clip
from server.reading import StoreReader
from server.store import Store
from tests.measured import latency_results, sweep_results
from tests.serving import KEY, PLAYED, filled, read, serving, serving_measured, settings


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, str]]:
    with serving_measured(tmp_path_factory.mktemp("serve")) as served:
        yield served


def figure(number: Figure | None) -> dict[str, Any] | None:
    if number is None:
        return None
    return {"value": None, "undefined": number.reason} if isinstance(number, Undefined) else {"value": number, "undefined": None}


def test_a_sweep_of_the_command_is_listed_with_what_was_asked(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    (sweep,) = read(client, "/api/v1/sweeps")["sweeps"]
    assert sweep == read(client, path) and path.endswith(sweep["id"])
    assert (sweep["origin"], sweep["progress"]["state"]) == ("command", "done")
    assert [clip["clip"] for clip in sweep["clips"]] == ["map", "track"] and sweep["clips"][0]["source"] is None
    assert sweep["upscalers"] == ["none", "bicubic", "lanczos", "easu", "fsr1", "gamesr"] and sweep["low_heights"] == [1080, 540, 360]
    assert sweep["progress"]["points_done"] == sweep["progress"]["points_total"] == len(sweep_results())


def test_points_and_curves_are_those_of_the_store(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    results = sweep_results()
    points = read(client, f"{path}/points")["points"]
    assert [point["key"] for point in points] == [result.point.key for result in results]
    assert points[0]["quality"] == results[0].quality.record() and points[0]["label"] == "native"
    assert len(read(client, f"{path}/points", clip="map")["points"]) == len(results) / 2
    for metric, title in METRICS.items():
        curves = read(client, f"{path}/curves", metric=metric)
        assert curves["metric_label"] == title and bool(curves["grades"]) == metric.startswith("vmaf")
        for clip, of_clip in zip(curves["clips"], series_by_clip(results).values(), strict=True):
            for curve, series in zip(clip["curves"], of_clip, strict=True):
                assert (curve["upscaler"], curve["low_height"], curve["undefined"]) == (series.upscaler, series.low_height, None)
                assert [point["quality"] for point in curve["points"]] == [getattr(r.quality, metric) for r in series.results]
                assert [point["bitrate_kbps"] for point in curve["points"]] == [r.bitrate_kbps for r in series.results]


def test_bd_rates_and_savings_are_what_the_same_functions_give(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    by_clip = series_by_clip(sweep_results())
    compared = [(clip, compare(s, anchor)) for clip, of_clip in by_clip.items() for s in of_clip for anchor in anchors(s, of_clip)]
    for record, (clip, comparison) in zip(read(client, f"{path}/bd-rates")["bd_rates"], compared, strict=True):
        assert (record["clip"], record["series"]["upscaler"]) == (clip, comparison.series.upscaler)
        assert record["anchor"]["low_height"] == comparison.anchor.low_height
        assert record["bd_rate_percent"] == {metric: figure(value) for metric, value in comparison.bd_rate_percent.items()}
        assert record["bd_quality"] == {metric: figure(value) for metric, value in comparison.bd_quality.items()}
    for target, metric in ((71.5, "vmaf"), (80, "vmaf_neg"), (99.9, "vmaf"), (0, "vmaf")):
        records = iter(read(client, f"{path}/savings", target=target, metric=metric)["savings"])
        for of_clip in by_clip.values():
            for series in of_clip:
                record = next(records)
                curve = series.curve(metric)
                over = {anchor.upscaler: saving(anchor.curve(metric), curve, target) for anchor in anchors(series, of_clip)}
                assert record["bitrate_kbps"] == figure(bitrate_at(curve, target))
                assert record["over_native_percent"] == figure(over.get("none"))
                assert record["over_bicubic_percent"] == figure(over.get("bicubic"))
    beyond = read(client, f"{path}/savings", target=99.9)["savings"][0]["bitrate_kbps"]
    assert beyond["value"] is None and "never reaches VMAF 99.9" in beyond["undefined"]


def test_latencies_have_percentiles_by_stage_and_the_share_of_missed_deadlines(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    latencies = read(client, f"{path}/latencies")["latencies"]
    for record, result in zip(latencies, latency_results(), strict=True):
        assert record["latency_us"] == {stage: summary.record() for stage, summary in result.latency_us.items()}
        shares = {deadline["fps"]: deadline["missed_share"] for deadline in record["deadlines"]}
        assert shares == {fps: missed / result.frames for fps, missed in result.deadline_misses.items()}
    assert latencies[0]["deadlines"][1]["deadline_us"] == pytest.approx(16666.67, abs=0.01)
    every = read(client, "/api/v1/latencies", upscaler="gamesr")["latencies"]
    assert {latency["upscaler"] for latency in every} == {"gamesr"} and len(every) == 4


def test_a_figure_that_is_missing_is_null_with_its_reason(tmp_path: Path) -> None:
    of = settings(tmp_path)
    results = sweep_results(("map",), (540,))
    quality = replace(results[0].quality, vmaf=None, undefined={"vmaf": "no ffmpeg"})
    sweep = filled(of.store, [replace(results[0], quality=quality), *results[1:]], [])
    with serving(of) as client:
        path = f"/api/v1/sweeps/{sweep}"
        assert read(client, f"{path}/points")["points"][0]["quality"]["undefined"] == {"vmaf": "no ffmpeg"}
        curve = read(client, f"{path}/curves")["clips"][0]["curves"][0]
        assert "no ffmpeg" in curve["undefined"] and curve["points"][0]["quality"] is None
        rates = read(client, f"{path}/bd-rates")["bd_rates"]
        assert all(
            "native 1080p has no VMAF" in r["bd_rate_percent"]["vmaf"]["undefined"] for r in rates if r["anchor"]["upscaler"] == "none"
        )


def test_an_answer_grows_with_the_store(tmp_path: Path) -> None:
    of = settings(tmp_path)
    results = sweep_results(("map",), (540,))
    with Store(of.store) as store, serving(of) as client:
        asked = AskedSweep.of([result.point for result in results], [])
        store.keep_sweep(asked)
        path = f"/api/v1/sweeps/{asked.key[:16]}"
        for count, result in enumerate(results[:3]):
            assert len(read(client, f"{path}/points")["points"]) == count
            assert read(client, path)["progress"]["points_done"] == count and read(client, path)["progress"]["state"] == "partial"
            store.keep_point(result)


def test_points_have_the_names_of_the_sweep_that_asks(tmp_path: Path) -> None:
    first, _ = results = sweep_results(("map",), (540,))[:2]
    filled(tmp_path / "store", results, [])
    renamed = [replace(result.point, clip="another name") for result in results]
    with Store(tmp_path / "store") as store:
        store.keep_sweep(AskedSweep.of([*renamed, replace(first.point, fps=30)], []))
    newest, _ = StoreReader(tmp_path / "store").sweeps().values()
    assert {result.point.clip for result in StoreReader(tmp_path / "store").points(newest.asked)} == {"another name"}


def test_latencies_have_the_names_of_the_sweep_that_asks(tmp_path: Path) -> None:
    results, latencies = sweep_results(("map",), (540,)), latency_results()[:2]
    filled(tmp_path / "store", results, latencies)
    points = [replace(result.point, clip="another name", upscaler=f"my {result.point.upscaler}") for result in results]
    reader = StoreReader(tmp_path / "store")
    found = reader.latencies(AskedSweep.of(points, ["latency 0", "latency 1"]))
    assert [(one.clip, one.upscaler) for one in found] == [("another name", f"my {one.upscaler}") for one in latencies]


def test_a_damaged_record_is_a_sentence_in_the_services_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    of = settings(tmp_path)
    sweep = filled(of.store, sweep_results(("map",), (540,)), [])
    with sqlite3.connect(of.store) as connection:
        connection.execute("UPDATE points SET record = replace(record, '\"flags\"', '\"banners\"')")
    with serving(of) as client:
        answer = client.get(f"/api/v1/sweeps/{sweep}/curves")
        assert answer.status_code == 503 and "see the service's log" in answer.json()["detail"]
    assert [record.message.startswith(f"the store {of.store} holds a record") for record in caplog.records] == [True]


def test_models_come_with_their_cards(measured: tuple[httpx.Client, str]) -> None:
    client, _ = measured
    models = read(client, "/api/v1/models")["models"]
    assert [f"{model['name']}_x{model['scale']}" for model in models] == [path.stem for path in shipped_models()]
    gamesr = read(client, "/api/v1/models/gamesr", scale=3)
    assert gamesr in models and gamesr["recurrent"] and gamesr["card_markdown"].startswith("# gamesr x3") and gamesr["card"]
    assert client.get("/api/v1/models/sharpest", params={"scale": 3}).status_code == 404


def test_health_readiness_and_figures_for_prometheus(measured: tuple[httpx.Client, str], tmp_path: Path) -> None:
    client, path = measured
    assert read(client, "/health") == {"status": "ok", "runner": False, "version": "0.1.0"}
    assert client.get("/ready").status_code == 200
    client.get(path)
    text = client.get("/metrics").text
    assert f"gamesr_store_points {len(sweep_results())}.0" in text and "gamesr_sweeps_waiting 0.0" in text
    assert 'gamesr_http_requests_total{method="GET",route="/sweeps/{sweep}",status="200"}' in text
    assert 'gamesr_frame_seconds{height="1080",low_height="540",quantile="p95",stage="total",upscaler="gamesr"}' in text
    with serving(settings(tmp_path)) as other:
        (tmp_path / "store.sqlite").write_text("no database " * 100)
        answer = other.get("/ready")
        assert answer.status_code == 503 and other.get("/health").status_code == 200
        assert "see the service's log" in answer.json()["detail"] and str(tmp_path) not in answer.text


def test_players_latencies_are_posted_with_the_key_and_listed(tmp_path: Path) -> None:
    with serving(settings(tmp_path, api_key=KEY)) as client:
        for wrong in ({}, {"X-API-Key": "wrong"}, {"X-API-Key": KEY[:-1]}, {"X-API-Key": KEY[::-1]}):
            answer = client.post("/api/v1/client-latencies", json=PLAYED, headers=wrong)
            assert answer.status_code == 401 and answer.headers["www-authenticate"] == "X-API-Key"
        answer = client.post("/api/v1/client-latencies", json=PLAYED, headers={"X-API-Key": KEY})
        assert answer.status_code == 201, answer.text
        (posted,) = read(client, "/api/v1/client-latencies")["latencies"]
        assert posted == answer.json() and (posted["width"], posted["frames"]) == (1920, 50)
        assert [(d["fps"], d["missed_share"]) for d in posted["deadlines"]] == [(30, 0.0), (60, 0.04), (120, 0.8)]
        falls = {**PLAYED, "latency_us": {"total": {"count": 50, "p50": 9, "p95": 8, "p99": 10, "max": 11}}}
        for unfit in (falls, {**PLAYED, "deadline_misses": {"60": 51}}, {**PLAYED, "more": 1}, {**PLAYED, "threads": "2"}, [], "x"):
            assert client.post("/api/v1/client-latencies", json=unfit, headers={"X-API-Key": KEY}).status_code == 422
        changes = [("POST", "sweeps"), ("POST", "sweeps/0123456789abcdef/cancel"), ("POST", "clips"), ("DELETE", "clips/x")]
        for method, path in changes:
            assert client.request(method, f"/api/v1/{path}").status_code == 401


def test_keys_are_compared_in_constant_time(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []

    def spied(one: bytes, other: bytes) -> bool:
        compared.append((len(one), len(other)))
        return hmac_compare(one, other)

    hmac_compare = hmac.compare_digest
    monkeypatch.setattr(guards.hmac, "compare_digest", spied)
    assert guards.same_key(KEY, KEY) and not guards.same_key("", KEY) and not guards.same_key("k" * 1000, KEY)
    assert compared == [(32, 32)] * 3


def test_errors_are_one_sentence_without_a_stack(
    measured: tuple[httpx.Client, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, path = measured
    for answer, status in (
        (client.get("/api/v1/sweeps/0123456789abcdef"), 404),
        (client.get("/api/v1/sweeps/..%2f..%2fetc%2fpasswd"), 404),
        (client.get(f"{path}/curves", params={"metric": "taste"}), 422),
        (client.get(f"{path}/savings", params={"target": "nan"}), 422),
        (client.put(path), 405),
        (client.post("/api/v1/client-latencies", content=b"{" * 100), 422),
        (client.post("/api/v1/client-latencies", content=b"x" * 100_000), 413),
    ):
        assert answer.status_code == status and list(answer.json()) == ["detail"] and "Traceback" not in answer.text
    with serving(settings(tmp_path)) as other:
        monkeypatch.setattr(StoreReader, "sweeps", lambda self: 1 / 0)
        answer = other.get("/api/v1/sweeps")
        assert answer.status_code == 500 and answer.json() == {"detail": "an error of the service: see its log"}


def test_the_page_and_its_files_are_served_and_nothing_beside_them(measured: tuple[httpx.Client, str]) -> None:
    client, _ = measured
    assert "text/html" in client.get("/").headers["content-type"]
    for path in ("/static/../app.py", "/static/..%2fapp.py", "/static/%2e%2e/app.py", "/static//etc/passwd", "/docs", "/redoc"):
        assert client.get(path).status_code == 404
