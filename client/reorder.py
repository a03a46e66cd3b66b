"""Packets in the order of their sequence numbers, and what is missing between them."""

from __future__ import annotations

from typing import Generic, TypeVar

PACKETS_HELD = 64
WAIT_NS = 8_000_000  # half a frame at 60 fps: what comes later would be too late for its frame
_GIVEN_UP_KEPT = 1024

Item = TypeVar("Item")


class ReorderBuffer(Generic[Item]):
    """Holds packets that came early until the missing ones come, `wait_ns` have passed or `packets_held` are held.

    A packet in order passes at once. `lost` counts numbers that were given up, `late` those of them that came after all,
    `duplicates` what came twice; neither of the latter passes.
    """

    def __init__(self, first: int, packets_held: int = PACKETS_HELD, wait_ns: int = WAIT_NS) -> None:
        self.lost = self.late = self.duplicates = 0
        self._next = first
        self._packets_held, self._wait_ns = packets_held, wait_ns
        self._held: dict[int, tuple[Item, int]] = {}
        self._given_up: set[int] = set()

    def push(self, number: int, item: Item, now_ns: int) -> list[tuple[int, Item]]:
        """Take a packet; returns what may pass, each with how many packets are missing directly before it."""
        if number < self._next or number in self._held:
            if number in self._given_up:
                self._given_up.discard(number)
                self.late += 1
            else:
                self.duplicates += 1
            return []
        self._held[number] = item, now_ns
        return self.release(now_ns)

    def release(self, now_ns: int) -> list[tuple[int, Item]]:
        """What may pass by now, without a new packet."""
        passed: list[tuple[int, Item]] = []
        missing = 0
        while self._held:
            if self._next not in self._held:
                if len(self._held) <= self._packets_held and now_ns < self._deadline_ns():
                    break
                missing = self._give_up()
            passed.append((missing, self._held.pop(self._next)[0]))
            self._next += 1
            missing = 0
        return passed

    def due_ns(self) -> int | None:
        """When `release` will have something to say; None where nothing is held."""
        return self._deadline_ns() if self._held else None

    def _deadline_ns(self) -> int:
        return min(arrived_ns for _, arrived_ns in self._held.values()) + self._wait_ns

    def _give_up(self) -> int:
        first = min(self._held)
        missing = first - self._next
        self.lost += missing
        self._given_up.update(range(max(self._next, first - _GIVEN_UP_KEPT), first))
        if len(self._given_up) > 2 * _GIVEN_UP_KEPT:
            self._given_up = {number for number in self._given_up if number >= first - _GIVEN_UP_KEPT}
        self._next = first
        return missing
