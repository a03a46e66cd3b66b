"""A service for the tests: in a thread of this process, or as its users start it, in one that can be killed."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from server.app import create_app
from server.asked import AskedSweep
from server.connections import bounded_protocol
from server.points import LatencyResult, PointResult
from server.settings import Limits, Settings
from server.store import Store
from tests.measured import latency_results, sweep_results

KEY = "a key of more than sixteen characters"
ROOT = Path(__file__).parent.parent
WAIT_S = 120.0
PLAYED: dict[str, Any] = {
    "model": "gamesr",
    "model_sha256": "0" * 64,
    "provider": "cpu",
    "threads": 2,
    "machine": "a player's",
    "low_width": 960,
    "low_height": 540,
    "scale": 2,
    "latency_us": {"total": {"count": 50, "p50": 9000.0, "p95": 12000, "p99": 20000, "max": 30000}},
    "deadline_misses": {"30": 0, "60": 2, "120": 40},
}


def settings(
    folder: Path,
    *,
    clips: Path | None = None,
    api_key: str | None = None,
    loopback: bool = True,
    public_name: str | None = None,
    **limits: Any,
) -> Settings:
    return Settings(folder / "store.sqlite", folder / "data", clips, api_key, loopback, 1, public_name, Limits(**limits))


@contextlib.contextmanager
def serving(of: Settings) -> Iterator[httpx.Client]:
    """A client of a service that is up, without a runner."""
    config = uvicorn.Config(
        create_app(of), http=bounded_protocol(of.limits), log_level="critical", server_header=False, timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{listener.getsockname()[1]}", timeout=30) as client:
                yield client
        finally:
            server.should_exit = True
            thread.join()


class Command:
    """gamesr-serve with its runner, a context manager that leaves nothing behind."""

    def __init__(self, *arguments: object, **environment: str) -> None:
        command = [sys.executable, "-c", "from server.serve import main; raise SystemExit(main())", "--port", "0", "--jobs", "1"]
        self._process = subprocess.Popen(
            [*command, *map(str, arguments)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=os.environ | environment,
        )
        assert self._process.stdout is not None
        self.url = self._process.stdout.readline().removeprefix("gamesr-serve: ").strip().removesuffix("/")
        self.client = httpx.Client(base_url=self.url, timeout=30)

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *_: object) -> None:
        self.end(signal.SIGTERM)

    @property
    def pid(self) -> int:
        return self._process.pid

    def end(self, signum: int) -> int:
        """Only the process itself gets the signal; returns its status."""
        self.client.close()
        if self._process.poll() is None:
            self._process.send_signal(signum)
        assert self._process.stdout is not None
        self._process.stdout.close()
        return self._process.wait()


def until(found: Callable[[], Any]) -> Any:
    """What the function returns once that is something."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        if result := found():
            return result
        time.sleep(0.05)
    raise AssertionError("it did not come")


def events(client: httpx.Client, sweep: str) -> Iterator[dict[str, Any]]:
    """The progress of a sweep, as it comes."""
    with client.stream("GET", f"/api/v1/sweeps/{sweep}/events") as answer:
        assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            if line.startswith("data: "):
                yield json.loads(line.removeprefix("data: "))


def filled(store: Path, results: Sequence[PointResult], latencies: Sequence[LatencyResult]) -> str:
    """A store with a sweep of these; returns its id."""
    with Store(store) as opened:
        asked = AskedSweep.of([result.point for result in results], [f"latency {n}" for n in range(len(latencies))])
        opened.keep_sweep(asked)
        for result in results:
            opened.keep_point(result)
        for key, latency in zip(asked.latencies, latencies, strict=True):
            opened.keep_latency(key, latency)
    return asked.key[:16]


@contextlib.contextmanager
def serving_measured(folder: Path) -> Iterator[tuple[httpx.Client, str]]:
    """A service over a sweep of two clips, and the sweep's path."""
    of = settings(folder)
    sweep = filled(of.store, sweep_results(), latency_results())
    with serving(of) as client:
        yield client, f"/api/v1/sweeps/{sweep}"


def read(client: httpx.Client, path: str, **query: Any) -> Any:
    answer = client.get(path, params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()
