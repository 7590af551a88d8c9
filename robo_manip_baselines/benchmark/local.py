"""Units in processes of this machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark import worker as work
from robo_manip_baselines.benchmark.scheduler import Outcome
from robo_manip_baselines.benchmark.work_item import LOG, Store, Unit

POLL = 0.05
"""s between looks at the processes, up to ten times that while nothing happens."""

PATIENCE = 30.0
"""s that an interrupted unit has to save its state."""


class LocalExecutor:
    """Starts a process for each unit.

    Args:
        store: holds the folders that they run in.
        workers: how many run at once.
    """

    def __init__(self, store: Store, workers: int) -> None:
        self._store = store
        self._workers = workers
        self._running: list[tuple[Unit, subprocess.Popen[bytes]]] = []

    def has_room(self, unit: Unit) -> bool:
        """Say whether a worker is free."""
        return len(self._running) < self._workers

    def workers(self, threads: int, gpus: float) -> int:
        """Return how many units run at once."""
        return self._workers

    def start(self, unit: Unit) -> None:
        """Start a unit in its folder."""
        folder = self._store.prepare(unit)
        self._running.append((unit, start_worker(unit.document(), folder, is_scratch=False)))

    def wait(self) -> Iterable[Outcome]:
        """Wait until a process has ended, for half a second at most."""
        end = time.monotonic() + 10 * POLL
        while time.monotonic() < end:
            ended = [
                (unit, process) for unit, process in self._running if process.poll() is not None
            ]
            if ended:
                self._running = [pair for pair in self._running if pair not in ended]
                return [self._outcome(unit, process) for unit, process in ended]
            time.sleep(POLL)
        return []

    def close(self) -> None:
        """Let processes save what they have, then end them."""
        for _, process in self._running:
            process.terminate()
        end = time.monotonic() + PATIENCE
        for _, process in self._running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(end - time.monotonic(), 0.0))
            _close(process)
            process.kill()
            process.wait()
        self._running = []

    def _outcome(self, unit: Unit, process: subprocess.Popen[bytes]) -> Outcome:
        _close(process)
        log = self._store.folder(unit) / LOG
        if process.returncode == 0 and self._store.is_done(unit):
            return Outcome(unit)
        last = last_line(log.read_text(encoding="utf-8", errors="replace"))
        problem = f"{last or f'exit code {process.returncode}'} (all of it: {log})"
        return Outcome(unit, problem, process.returncode)


def start_worker(
    document: Mapping[str, Any], folder: Path, *, is_scratch: bool
) -> subprocess.Popen[bytes]:
    """Start the process of a unit, which ends with this one.

    Args:
        document: what to do, see ``Unit.document``.
        folder: of the unit, with what it reads.
        is_scratch: whether the folder goes if this process ends before the unit.
    """
    threads = str(document["threads"])
    environment = {
        **os.environ,
        **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads),
        "TQDM_DISABLE": "1",
    }
    with (folder / LOG).open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", work.__name__, *([work.SCRATCH] if is_scratch else [])],
            cwd=folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    if process.stdin:
        with suppress(BrokenPipeError):  # it has failed already: its exit code says so
            process.stdin.write(json.dumps(document).encode() + b"\n")
            process.stdin.flush()
    return process


def last_line(log: str) -> str:
    """Return the last line of a log that says something."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    return lines[-1].removeprefix("error: ") if lines else ""


def _close(process: subprocess.Popen[bytes]) -> None:
    if process.stdin:
        with suppress(BrokenPipeError):
            process.stdin.close()
