"""Speed of training beside other programs: number of threads, and how they wait for one another.

Trains ACT's preset ``cpu`` for a few steps in processes of its own, idle and beside one busy loop
for every core, and prints steps per second with the ratio to PyTorch's own settings on an idle
machine. Rounds are interleaved, so that other work on the machine meets all settings alike.
Run: ``python benchmarks/busy_cores.py --rounds 3``.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

CORES = len(os.sched_getaffinity(0))

SETTINGS: dict[str, dict[str, str]] = {
    # GNU OpenMP's own count where there are no more threads than cores: some milliseconds
    "PyTorch's own": {"GOMP_SPINCOUNT": "300000", "OMP_NUM_THREADS": str(CORES)},
    "as chosen by the load": {"OMP_NUM_THREADS": str(CORES)},
    "GOMP_SPINCOUNT=3000": {"GOMP_SPINCOUNT": "3000", "OMP_NUM_THREADS": str(CORES)},
    "GOMP_SPINCOUNT=0": {"GOMP_SPINCOUNT": "0", "OMP_NUM_THREADS": str(CORES)},
    "one thread": {"GOMP_SPINCOUNT": "3000", "OMP_NUM_THREADS": "1"},
}
"""Name -> environment of the training."""

BENCHMARK = Path(__file__).with_name("train_step.py")


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Keep so many cores busy for the length of a block."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def steps_per_second(setting: dict[str, str], steps: int) -> float:
    """Train for so many steps and return the speed after the warm-up."""
    command = [sys.executable, str(BENCHMARK), "Act", "--preset", "cpu", f"--steps={steps}"]
    env = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    output = subprocess.run(
        command, env={**env, **setting}, check=True, capture_output=True, text=True
    ).stdout
    match = re.search(r"\| step \| ([0-9.]+) \|", output)
    assert match is not None, output
    return 1e3 / float(match[1])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=35)
    options = parser.parse_args()
    found: dict[tuple[str, int], list[float]] = {}
    for _ in range(options.rounds):
        for loops in (0, CORES):
            for name, setting in SETTINGS.items():
                with busy_loops(loops):
                    speed = steps_per_second(setting, options.steps)
                found.setdefault((name, loops), []).append(speed)
                print(f"{name}, {loops} busy loops: {speed:.2f} steps/s", file=sys.stderr)
    speeds = {key: median(values) for key, values in found.items()}
    base = speeds[next(iter(SETTINGS)), 0]
    print(f"ACT, preset cpu, {CORES} cores, medians of {options.rounds} rounds; 1 = {base:.2f}/s\n")
    print(f"| waiting and threads | idle | {CORES} busy loops |\n|---|---|---|")
    for name in SETTINGS:
        print(f"| {name} | {speeds[name, 0] / base:.2f} | {speeds[name, CORES] / base:.2f} |")


if __name__ == "__main__":
    main()
