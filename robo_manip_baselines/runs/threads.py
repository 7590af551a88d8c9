"""The cores of this process, and how OpenMP's threads wait for one another on them."""

from __future__ import annotations

import os
import time
from pathlib import Path

SPINS = 3000
"""Spins of an OpenMP thread before it sleeps, some 10 us, where cores are idle. Chosen with ACT's
preset ``cpu`` on two cores: 0 gave 13 steps/s on an idle machine, 3000 gave 20, 30 000 gave 21."""

LOOK = 0.1
"""s over which the load of the cores is measured."""

TAKEN = 0.5
"""Share of its time for which a core works before it counts as taken by another program."""


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def choose_waiting() -> None:
    """Set how the threads of GNU OpenMP wait; call it before PyTorch is imported.

    Threads that have nothing to do spin for long before they sleep, which takes the processor from
    the thread that they wait for as soon as another program is running. Asleep at once, they cost
    as much to wake on an idle machine as they save. So they spin for a short time where a core is
    idle for each of them, and sleep at once where other programs have taken one;
    ``GOMP_SPINCOUNT`` and ``OMP_WAIT_POLICY`` override it. Results do not depend on it, as they
    would on the number of threads, which is left alone.
    """
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
        os.environ["GOMP_SPINCOUNT"] = str(0 if taken_cores() else SPINS)


def taken_cores(stat: Path = Path("/proc/stat")) -> int:
    """Return how many of the cores of this process other programs keep busy; 0 if unknown."""
    try:
        before = _core_times(stat)
        time.sleep(LOOK)
        after = _core_times(stat)
    except (OSError, ValueError, IndexError):  # not Linux, or another kernel
        return 0
    taken = 0
    for core in before.keys() & after.keys():
        total, idle = (new - old for new, old in zip(after[core], before[core], strict=True))
        taken += total > 0 and (total - idle) / total > TAKEN
    return taken


def _core_times(stat: Path) -> dict[int, tuple[int, int]]:
    """Return the time of each core of this process: in all, and idle; in ticks of the kernel."""
    times = {}
    own = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    for line in stat.read_text(encoding="ascii").splitlines():
        name, *numbers = line.split()
        if name.startswith("cpu") and name[3:].isdecimal() and int(name[3:]) in own:
            ticks = list(map(int, numbers[:8]))  # guests are counted as user time
            times[int(name[3:])] = sum(ticks), ticks[3] + ticks[4]  # idle, waiting for a disk
    return times
