"""A network that loses, by seed: when each datagram comes out, for whoever has a clock of his own."""

from __future__ import annotations

import random
from dataclasses import dataclass


@dataclass(frozen=True)
class Weather:
    """What a link does to datagrams. Shares are of 0..1; times are in ns; a rate of 0 is none.

    Before `begin_ns` it only delays.

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
    begin_ns: int = 0


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
        if now_ns < weather.begin_ns:
            return [now_ns + weather.delay_ns]
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
