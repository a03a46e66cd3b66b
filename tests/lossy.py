"""A network that loses, by seed: as a rule over times for tests that have their own clock, and as a UDP proxy for those that have not."""

from __future__ import annotations

import heapq
import itertools
import random
import socket
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Self


@dataclass(frozen=True)
class Weather:
    """What a link does to datagrams. Shares are of 0..1; times are in ns; a rate of 0 is none.

    With `burst_packets` losses come as in Gilbert and Elliott's model: a bad state that loses everything, so many packets long
    on average, entered so that `loss` is the share lost in all.
    """

    loss: float = 0.0
    burst_packets: float = 0.0
    reorder: float = 0.0
    reorder_ns: int = 3_000_000
    duplicate: float = 0.0
    delay_ns: int = 0
    jitter_ns: int = 0
    rate_kbps: int = 0
    queue_ns: int = 50_000_000  # what would wait longer for its turn is dropped


class Link:
    """One direction: tells when each datagram comes out, if it does, and how often."""

    def __init__(self, weather: Weather, seed: int) -> None:
        self.dropped = 0
        self._weather, self._random = weather, random.Random(seed)
        self._bad = False
        self._free_ns = 0

    def carry(self, size: int, now_ns: int) -> list[int]:
        """Times of delivery of a datagram of `size` bytes that goes in now."""
        weather, draw = self._weather, self._random.random
        lost = self._lost()
        if weather.rate_kbps:
            begin = max(now_ns, self._free_ns)
            if begin - now_ns > weather.queue_ns:
                lost = True
            else:
                self._free_ns = now_ns = begin + size * 8_000_000 // weather.rate_kbps
        if lost:
            self.dropped += 1
            return []
        times = [now_ns + weather.delay_ns + int(draw() * weather.jitter_ns) for _ in range(1 + (draw() < weather.duplicate))]
        return [at + (weather.reorder_ns if draw() < weather.reorder else 0) for at in times]

    def _lost(self) -> bool:
        weather, draw = self._weather, self._random.random()
        if not weather.burst_packets:
            return draw < weather.loss
        leave = 1 / weather.burst_packets
        enter = leave * weather.loss / (1 - weather.loss)
        self._bad = draw >= leave if self._bad else draw < enter
        return self._bad


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
