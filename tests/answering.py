"""A web server for the tests, whatever it is to answer: in a thread of this process."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer


class QuietHandler(BaseHTTPRequestHandler):
    """Prints nothing; a test adds the methods that it needs."""

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def answering(handler: type[QuietHandler]) -> Iterator[str]:
    """The URL of a server that makes a handler for every request, without a slash at its end."""
    with HTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
