"""Memory of the machine."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

UNKNOWN_MEMORY = 4 * 2**30
"""Bytes assumed to be free where the system does not report it."""


def free_memory() -> int:
    """Return the bytes of memory that are free, or that the container has left, if that is less."""
    free = [UNKNOWN_MEMORY]
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = [next(1024 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable:"))]
    with suppress(OSError, ValueError):  # "max", no number, where there is no limit
        limit, used = (
            int(Path(f"/sys/fs/cgroup/memory.{name}").read_text(encoding="ascii"))
            for name in ("max", "current")
        )
        free.append(max(limit - used, 0))
    return min(free)
