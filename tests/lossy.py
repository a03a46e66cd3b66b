"""A network that loses, by seed, as a UDP proxy in the process."""

from __future__ import annotations

import heapq
import itertools
import socket
import threading
import time
from types import TracebackType
from typing import Self

from server.link import Link, Weather


class LossyProxy:
    """UDP in the process: what comes from anywhere goes to `target` through `forth`, what comes from there back to the newest source."""

    def __init__(self, target: tuple[str, int], forth: Weather, back: Weather, seed: int) -> None:
        self._target = target
        self._front, self._rear = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for end in (self._front, self._rear):
            end.bind(("127.0.0.1", 0))
            end.settimeout(0.001)
        self.address: tuple[str, int] = self._front.getsockname()
        self._links = {True: Link(forth, seed), False: Link(back, seed + 1)}
        self._source: tuple[str, int] | None = None
        self._held: list[tuple[int, int, bool, bytes]] = []
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        self._closed = False
        self._threads = [threading.Thread(target=self._run, args=(forward,), daemon=True) for forward in (True, False)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._closed = True
        for thread in self._threads:
            thread.join()
        self._front.close()
        self._rear.close()

    def _run(self, forward: bool) -> None:
        entrance = self._front if forward else self._rear
        while not self._closed:
            try:
                datagram, address = entrance.recvfrom(65535)
            except OSError:
                datagram, address = b"", None
            now_ns = time.perf_counter_ns()
            with self._lock:
                if address is not None:
                    self._source = address if forward else self._source
                    for at in self._links[forward].carry(len(datagram), now_ns):
                        heapq.heappush(self._held, (at, next(self._numbers), forward, datagram))
                while self._held and self._held[0][0] <= now_ns:
                    _, _, onward, held = heapq.heappop(self._held)
                    if onward:
                        self._rear.sendto(held, self._target)
                    elif self._source is not None:
                        self._front.sendto(held, self._source)
