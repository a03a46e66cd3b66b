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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from server.app import create_app
from server.connections import bounded_protocol
from server.settings import Limits, Settings

KEY = "a key of more than sixteen characters"
ROOT = Path(__file__).parent.parent
WAIT_S = 120.0


def settings(folder: Path, *, clips: Path | None = None, api_key: str | None = None, loopback: bool = True, **limits: Any) -> Settings:
    return Settings(folder / "store.sqlite", folder / "data", clips, api_key, loopback, jobs=1, limits=Limits(**limits))


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
