"""The processor: what it is called, how many threads are worth starting, and whether others want it too."""

from __future__ import annotations

import os
import platform
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

_LOOK_NS = 1_000_000_000  # the system counts in hundredths of a second


def physical_cores() -> int:
    """Physical cores among the logical ones that this process may run on; at least 1."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    logical = os.sched_getaffinity(0)
    try:
        return len({Path(f"/sys/devices/system/cpu/cpu{n}/topology/thread_siblings_list").read_text() for n in logical})
    except OSError:
        return len(logical)


def machine_name() -> str:
    """The processor's name where the system tells it, else its kind."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*:\s*(.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.is_file() else None
    return found[1] if found else platform.processor() or platform.machine()


@dataclass(frozen=True, slots=True)
class CoreTime:
    """At a time of `perf_counter_ns`: for how long the cores that this process may use have been idle, and it has been computing."""

    at_ns: int
    idle_ns: int
    own_ns: int


def core_time() -> CoreTime | None:
    """Now; None where the system does not tell, that is without Linux's /proc/stat."""
    try:
        logical = {f"cpu{n}" for n in os.sched_getaffinity(0)}
        rows = [line.split() for line in Path("/proc/stat").read_text().splitlines() if line.startswith("cpu")]
        idle_ticks = sum(int(row[4]) + int(row[5]) for row in rows if row[0] in logical)  # idle, and waiting for a disk
        tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    except (AttributeError, OSError, ValueError, IndexError):
        return None
    return CoreTime(time.perf_counter_ns(), idle_ticks * tick_ns, time.process_time_ns())


class Crowding:
    """Whether `threads` threads would find a core each: not where less is idle or ours than they want, to half a core.

    It is looked up once a second, of the second before. Where the system does not tell, never.
    """

    def __init__(self, threads: int, look: Callable[[], CoreTime | None] = core_time) -> None:
        self._threads, self._look = threads, look
        self._before, self._crowded = look(), False

    def at(self, now_ns: int) -> bool:
        before = self._before
        if before is None or now_ns - before.at_ns < _LOOK_NS or (now := self._look()) is None:
            return self._crowded
        free_cores = (now.idle_ns - before.idle_ns + now.own_ns - before.own_ns) / (now.at_ns - before.at_ns)
        self._before, self._crowded = now, free_cores < self._threads - 0.5
        return self._crowded
