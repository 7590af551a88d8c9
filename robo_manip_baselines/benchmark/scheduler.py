"""Scheduling of work items: dependencies, an executor on this machine, and one progress bar."""

from __future__ import annotations

import logging
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import fmean
from typing import Protocol

from robo_manip_baselines.benchmark.work_item import LOG, ArtifactStore, WorkItem
from robo_manip_baselines.benchmark.worker import end_worker, failure, start_worker
from robo_manip_baselines.runs.command import EXIT_WRONG_REQUEST
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.progress import ProgressBar, duration

POLL = 0.05
"""s between checks of the processes."""

WAIT = 0.5
"""s to wait for a result before the progress is shown again."""

PATIENCE = 30.0
"""s that an interrupted work item has to save its state."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkResult:
    """End of the work on an item; the store holds the outputs.

    Attributes:
        item: that was worked on.
        problem: one line; empty where the item is done.
        code: exit code of its process.
    """

    item: WorkItem
    problem: str = ""
    code: int = 0


class Executor(Protocol):
    """Place where work items run."""

    def has_room(self, item: WorkItem) -> bool:
        """Return True if an item can be started now."""
        ...

    def workers(self, threads: int, gpus: float) -> int:
        """Return how many items that need so much run at once."""
        ...

    def start(self, item: WorkItem) -> None:
        """Start an item whose needs are done."""
        ...

    def wait(self) -> Iterable[WorkResult]:
        """Wait for results, for half a second at most."""
        ...

    def close(self) -> None:
        """End all running items, which can be continued later."""
        ...


class LocalExecutor:
    """Runs each item in a process of this machine.

    Args:
        store: holds the folders of the items.
        workers: number of processes.
    """

    def __init__(self, store: ArtifactStore, workers: int) -> None:
        self._store, self._workers = store, workers
        self._running: list[tuple[WorkItem, subprocess.Popen[bytes]]] = []

    def has_room(self, item: WorkItem) -> bool:
        """Return True if a worker is free."""
        return len(self._running) < self._workers

    def workers(self, threads: int, gpus: float) -> int:
        """Return the number of processes."""
        return self._workers

    def start(self, item: WorkItem) -> None:
        """Start an item in its folder."""
        self._running.append((item, start_worker(item.to_json(), self._store.prepare(item))))

    def wait(self) -> Iterable[WorkResult]:
        """Wait until a process has ended, for half a second at most."""
        end = time.monotonic() + WAIT
        while time.monotonic() < end:
            ended = [pair for pair in self._running if pair[1].poll() is not None]
            if ended:
                self._running = [pair for pair in self._running if pair not in ended]
                return [self._result(item, process) for item, process in ended]
            time.sleep(POLL)
        return []

    def close(self) -> None:
        """Let processes save their state, then end them."""
        for _, process in self._running:
            process.terminate()
        end = time.monotonic() + PATIENCE
        for _, process in self._running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(end - time.monotonic(), 0.0))
            end_worker(process)
        self._running = []

    def _result(self, item: WorkItem, process: subprocess.Popen[bytes]) -> WorkResult:
        end_worker(process)
        if process.returncode == 0 and self._store.is_done(item):
            return WorkResult(item)
        log = self._store.folder(item) / LOG
        text = log.read_text(encoding="utf-8", errors="replace")
        problem = f"{failure(process.returncode, text)} (all of it: {log})"
        return WorkResult(item, problem, process.returncode)


class ItemsFailedError(RuntimeError):
    """Some work items failed; the others are done."""


def run_items(
    items: Sequence[WorkItem], store: ArtifactStore, executor: Executor, progress: GridProgress
) -> None:
    """Do all work items that are not done yet.

    After a failure, everything that does not need the failed item is still done.

    Args:
        items: in order of priority.
        store: of their outputs.
        executor: that runs them.
        progress: over these and perhaps further items.

    Raises:
        RequestError: an item reports a wrong request.
        ItemsFailedError: items failed, all others are done.
    """
    waiting = {item.key: item for item in items if not store.is_done(item)}
    # For each item, those of its needs that are not done.
    needs = {
        key: {need.key for need in item.needs if not store.is_done(need)}
        for key, item in waiting.items()
    }
    for key, item in waiting.items():
        if not needs[key] <= waiting.keys():
            raise ValueError(f"{item.folder} needs items that are neither done nor given")
    done: set[str] = set()
    failed: list[WorkItem] = []
    running = 0
    while True:
        for item in list(waiting.values()):
            if needs[item.key] <= done and executor.has_room(item):
                executor.start(waiting.pop(item.key))
                progress.start(item)
                running += 1
        if not running:  # nothing waits, or only what needs failed items
            break
        for result in executor.wait():
            running -= 1
            item = result.item
            manifest = store.manifest(item)
            progress.end(item, None if manifest is None else float(manifest["seconds"]))
            if result.code == EXIT_WRONG_REQUEST:
                raise RequestError(f"{item}: {result.problem}")
            if result.problem:
                logger.error("%s failed: %s", item, result.problem)
                failed.append(item)
            else:
                done.add(item.key)
        progress.show()
    if failed:
        raise ItemsFailedError(
            f"{len(failed)} work items failed, the first of them {failed[0]}; everything that does "
            "not need them is done, and the same command tries them again"
        )


class GridProgress:
    """Progress over a grid of work items, in units of time.

    The cost of an item is the mean over the finished items of its kind, in proportion to the
    expected durations; before one has finished, the expected duration.

    Args:
        items: all of them.
        workers: how many run at once.
        later: s of work that follows and is not planned yet.
        clock: current time, s.
        bar: whether to show it.
    """

    def __init__(
        self,
        items: Iterable[WorkItem],
        workers: int,
        *,
        later: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        bar: bool = True,
    ) -> None:
        self._items = {item.key: item for item in items}
        self._workers, self._later, self._clock = workers, later, clock
        self._seconds: dict[str, float] = {}
        self._ended: set[str] = set()
        self._started: dict[str, float] = {}
        form = "{percentage:3.0f}% |{bar}| {elapsed}{postfix}"
        self._bar = ProgressBar(1.0, "", shown=bar, form=form, clock=clock)

    def add(self, items: Iterable[WorkItem]) -> None:
        """Add the items that were to follow later."""
        self._later = 0.0
        self._items |= {item.key: item for item in items}

    def start(self, item: WorkItem) -> None:
        """Count an item as started."""
        self._started[item.key] = self._clock()

    def end(self, item: WorkItem, seconds: float | None) -> None:
        """Count an item as ended; ``seconds`` is its duration, None if it failed."""
        self._started.pop(item.key, None)
        self._ended.add(item.key)
        if seconds is not None:
            self._seconds[item.key] = seconds

    @property
    def fraction(self) -> float:
        """Share of the work, 0 to 1, that is done."""
        total = sum(map(self.cost, self._items.values())) + self._later
        return 1.0 - (sum(self._remaining()) + self._later) / total if total else 1.0

    @property
    def seconds_left(self) -> float:
        """Seconds until everything is done."""
        remaining = self._remaining()
        return max((sum(remaining) + self._later) / self._workers, *remaining, 0.0)

    def cost(self, item: WorkItem) -> float:
        """Return the duration of an item, measured or expected, in s."""
        if item.key in self._seconds:
            return self._seconds[item.key]
        ratios = [
            seconds / self._items[key].seconds
            for key, seconds in self._seconds.items()
            if self._items[key].kind == item.kind
        ]
        return item.seconds * (fmean(ratios) if ratios else 1.0)

    def show(self) -> None:
        """Show the share of the work that is done, the time left, and what is being done.

        Items differ a hundredfold in their work, and videos are planned last: their count is no
        measure of it, and is not shown beside the share.
        """
        running = [str(self._items[key]) for key in self._started]
        more = f" and {len(running) - 1} more" if len(running) > 1 else ""
        now = [f"{running[0]}{more}"] if running else []
        self._bar.note = ", ".join([f"about {duration(self.seconds_left)} left", *now])
        self._bar.move_to(self.fraction)
        self._bar.refresh()

    def close(self) -> None:
        """Draw the bar for the last time."""
        self.show()
        self._bar.close()

    def _remaining(self) -> list[float]:
        """Return the s of each item that has not ended; 0 for one that has exceeded its cost."""
        now = self._clock()
        return [
            max(self.cost(item) - (now - self._started.get(key, now)), 0.0)
            for key, item in self._items.items()
            if key not in self._ended
        ]
