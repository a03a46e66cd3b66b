"""What holds for any answer over HTTP: its headers, who is let in, methods, what a browser keeps, and the description."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from server.asked import AskedSweep
from server.requests import ClientLatencyRequest, SweepRequest
from server.store import Store
from tests.measured import sweep_results
from tests.serving import KEY, PLAYED, read, serving, serving_measured, settings, until


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, str]]:
    with serving_measured(tmp_path_factory.mktemp("serve")) as served:
        yield served


def test_every_answer_says_what_a_browser_has_to_beware_of_and_no_other_origin_is_let_in(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    for answer in (client.get(path), client.get("/nothing"), client.get("/"), client.post("/api/v1/sweeps", json={})):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "script-src 'self'" in policy and "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff" and answer.headers["x-frame-options"] == "DENY"
        assert not any(name.startswith("access-control") for name in answer.headers) and "server" not in answer.headers
    assert "access-control-allow-origin" not in client.get(path, headers={"Origin": "https://evil.example"}).headers
    for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}, {"Origin": "null"}, {"Origin": "http://["}):
        assert client.post("/api/v1/client-latencies", json=PLAYED, headers=headers).status_code == 403
    own = {"Origin": str(client.base_url).rstrip("/"), "Sec-Fetch-Site": "same-origin"}
    assert client.post("/api/v1/client-latencies", json=PLAYED, headers=own).status_code == 201
    assert client.get(path, headers={"Host": "evil.example"}).status_code == 403
    assert client.get(path, headers={"Host": f"127.0.0.2:{client.base_url.port}"}).status_code == 200


def test_a_proxys_name_is_let_in_and_no_other(tmp_path: Path) -> None:
    """Whether the proxy passes the name on or not; a site that makes its own name point here is still another one."""
    with serving(settings(tmp_path, api_key=KEY, public_name="gamesr.example.com:8443")) as client:

        def status(host: str | None, origin: str, site: str = "same-origin") -> int:
            headers = {"X-API-Key": KEY, "Origin": origin, "Sec-Fetch-Site": site} | ({"Host": host} if host else {})
            return client.post("/api/v1/client-latencies", json=PLAYED, headers=headers).status_code

        public, own = "https://gamesr.example.com:8443", str(client.base_url).rstrip("/")
        for host in (None, "gamesr.example.com:8443", "gamesr.example.com", "GAMESR.example.com"):
            assert status(host, public) == 201 and status(host, public, "cross-site") == 403
            for other in ("https://evil.example", "https://gamesr.example.com:9999", "https://sub.gamesr.example.com:8443", "null"):
                assert status(host, other) == 403
        assert status(None, own) == 201
        for host in ("evil.example", "sub.gamesr.example.com", "gamesr.example.com.evil.example", ""):
            assert status(host, public) == 403 or not host
            assert client.get("/health", headers={"Host": host or "evil.example"}).status_code == 403


def test_head_is_answered_wherever_get_is(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    for address in ("/", "/health", "/ready", "/metrics", "/static/app.js", "/api/v1/openapi.json", path, f"{path}/curves"):
        head, got = client.head(address), client.get(address)
        assert head.status_code == got.status_code == 200 and head.content == b"" and got.content
        assert head.headers["content-type"] == got.headers["content-type"]
        if address != "/metrics":
            assert head.headers["content-length"] == str(len(got.content))
    assert client.head("/nothing").status_code == client.head("/api/v1/sweeps/0123456789abcdef").status_code == 404
    assert 'method="HEAD",route="/sweeps/{sweep}/curves",status="200"' in client.get("/metrics").text


def test_head_of_a_stream_of_events_keeps_no_place_in_it(tmp_path: Path) -> None:
    of = settings(tmp_path, events_at_once=1)
    results = sweep_results(("map",), (540,))
    with Store(of.store) as store, serving(of) as client:
        asked = AskedSweep.of([result.point for result in results], [])
        store.keep_sweep(asked)  # of which nothing is there: its events would go on for minutes
        for _ in range(3):
            answer = until(lambda: (answer := client.head(f"/api/v1/sweeps/{asked.key[:16]}/events")).status_code == 200 and answer)
            assert answer.headers["content-type"].startswith("text/event-stream")


def test_a_method_that_is_not_taken_is_told_which_ones_are(measured: tuple[httpx.Client, str]) -> None:
    client, path = measured
    cases = {
        ("PUT", "/api/v1/sweeps"): {"GET", "HEAD", "POST"},
        ("OPTIONS", "/api/v1/sweeps"): {"GET", "HEAD", "POST"},
        ("PUT", "/api/v1/clips/x"): {"GET", "HEAD", "DELETE"},
        ("HEAD", f"{path}/cancel"): {"POST"},
        ("DELETE", path): {"GET", "HEAD"},
        ("POST", "/static/app.js"): {"GET", "HEAD"},
    }
    for (method, address), allowed in cases.items():
        answer = client.request(method, address)
        assert answer.status_code == 405 and set(answer.headers["allow"].split(", ")) == allowed, (method, address)


def test_the_page_and_its_files_are_kept_and_asked_for_again(measured: tuple[httpx.Client, str]) -> None:
    client, _ = measured
    for path in ("/", "/static/app.js", "/static/style.css"):
        first = client.get(path)
        again = client.get(path, headers={"If-None-Match": first.headers["etag"]})
        assert first.status_code == 200 and first.headers["cache-control"] == again.headers["cache-control"] == "no-cache"
        assert (again.status_code, again.content) == (304, b"")
        assert client.get(path, headers={"If-None-Match": '"another"'}).content == first.content


def test_the_examples_of_the_description_are_taken(measured: tuple[httpx.Client, str]) -> None:
    client, _ = measured
    schemas = read(client, "/api/v1/openapi.json")["components"]["schemas"]
    for model in (SweepRequest, ClientLatencyRequest):
        (example,) = schemas[model.__name__]["examples"]
        assert model.model_validate(example).model_dump(exclude_unset=True)
    played = schemas["ClientLatencyRequest"]["examples"][0]
    assert client.post("/api/v1/client-latencies", json=played).status_code == 201
