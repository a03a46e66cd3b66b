"""The processor: what it is called, and how many threads are worth starting."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
CGROUP = Path("/sys/fs/cgroup")  # in a container its own


def physical_cores() -> int:
    """Physical cores among the logical ones that this process may run on, and no more than a container grants; at least 1."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    logical = os.sched_getaffinity(0)
    try:
        cores = len({Path(f"/sys/devices/system/cpu/cpu{n}/topology/thread_siblings_list").read_text() for n in logical})
    except OSError:
        cores = len(logical)
    return min(cores, _granted() or cores)


def _granted() -> int | None:
    """As many cores as a container's time on the processor comes to, rounded up; None where it is not limited."""
    for names in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):  # of cgroup 2 and 1
        try:
            quota, period = " ".join((CGROUP / name).read_text() for name in names).split()
        except OSError:
            continue
        return None if quota in ("max", "-1") else -(-int(quota) // int(period))
    return None


def machine_name() -> str:
    """The processor's name where the system tells it, else its kind."""
    return _told("model name") or platform.processor() or platform.machine()


def has_amx() -> bool:
    """Whether the system tells of a processor that multiplies matrices of bfloat16 and of 8 bits (Intel AMX)."""
    return {"amx_tile", "amx_bf16", "amx_int8"} <= set(_told("flags").split())


def _told(what: str) -> str:
    """Of the first processor, by Linux; empty where nothing is said."""
    found = re.search(rf"^{what}\s*:\s*(.+)$", CPUINFO.read_text(), re.MULTILINE) if CPUINFO.is_file() else None
    return found[1] if found else ""
