"""One bar over the whole grid, in units of time: what is done, and how long the rest will take."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Protocol

from tqdm import tqdm

from robo_manip_baselines.benchmark.work_item import Store, Unit
from robo_manip_baselines.runs.command import EXIT_WRONG_REQUEST
from robo_manip_baselines.runs.errors import RequestError

FORMAT = "{percentage:3.0f}% |{bar}| {desc}"


class Progress:
    """How far a benchmark is.

    What a unit costs is what units of its kind have taken, in proportion to what was expected of
    them; as long as none has ended, what was expected.

    Args:
        units: all of them.
        workers: how many run at once.
        later: s of work that comes after the units and is not planned yet.
        clock: tells seconds.
        bar: whether to draw.
    """

    def __init__(
        self,
        units: Iterable[Unit],
        workers: int,
        *,
        later: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        bar: bool = True,
    ) -> None:
        self._units = {unit.key: unit for unit in units}
        self._workers = workers
        self.later = later
        self._clock = clock
        self._took: dict[str, float] = {}
        self._ended: set[str] = set()
        self._since: dict[str, float] = {}
        self._bar = tqdm(total=1.0, bar_format=FORMAT, disable=not bar)
        self._shown = -1

    def add(self, units: Iterable[Unit]) -> None:
        """Take the units in that were to come later."""
        self.later = 0.0
        self._units |= {unit.key: unit for unit in units}

    def started(self, unit: Unit) -> None:
        """Note that a unit has been started."""
        self._since[unit.key] = self._clock()

    def ended(self, unit: Unit, seconds: float | None) -> None:
        """Note that a unit has ended, and how many seconds it took if it was done."""
        self._since.pop(unit.key, None)
        self._ended.add(unit.key)
        if seconds is not None:
            self._took[unit.key] = seconds

    @property
    def fraction(self) -> float:
        """Share of the work, 0 to 1, that is done."""
        total = sum(map(self.cost, self._units.values())) + self.later
        return 1.0 - (sum(self._remaining()) + self.later) / total if total else 1.0

    @property
    def seconds_left(self) -> float:
        """Seconds until everything is done."""
        remaining = self._remaining()
        return max((sum(remaining) + self.later) / self._workers, *remaining, 0.0)

    def cost(self, unit: Unit) -> float:
        """Return how many seconds a unit takes, or has taken."""
        if unit.key in self._took:
            return self._took[unit.key]
        ratios = [
            took / self._units[key].seconds
            for key, took in self._took.items()
            if self._units[key].kind == unit.kind
        ]
        return unit.seconds * (fmean(ratios) if ratios else 1.0)

    def show(self) -> None:
        """Draw the bar; where it cannot be drawn over, as in a log, only after a unit has ended."""
        if not self._bar.disable and (self._shown != len(self._ended) or sys.stderr.isatty()):
            self._shown = len(self._ended)
            count = f"{len(self._ended)} of {len(self._units)} units"
            count += " before the videos" if self.later else ""
            self._bar.n = self.fraction
            self._bar.set_description_str(f"{count}, {spelt(self.seconds_left)} left")

    def close(self) -> None:
        """Draw it for the last time."""
        self.show()
        self._bar.close()

    def _remaining(self) -> list[float]:
        """Seconds of each unit that has not ended; one that takes longer is as good as done."""
        now = self._clock()
        return [
            max(self.cost(unit) - (now - self._since.get(key, now)), 0.0)
            for key, unit in self._units.items()
            if key not in self._ended
        ]


def spelt(seconds: float) -> str:
    """Spell a duration: ``45 s``, ``12 min``, ``1 h 05 min``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """How the work on a unit ended; the store holds what it made.

    Attributes:
        unit: which one.
        problem: what went wrong, in one line; empty where it is done.
        code: exit code of its process.
    """

    unit: Unit
    problem: str = ""
    code: int = 0


class Executor(Protocol):
    """Where units run."""

    def has_room(self, unit: Unit) -> bool:
        """Say whether a unit may be started now."""
        ...

    def workers(self, threads: int, gpus: float) -> int:
        """Return how many units that need so much run at once."""
        ...

    def start(self, unit: Unit) -> None:
        """Start a unit whose needs are done."""
        ...

    def wait(self) -> Iterable[Outcome]:
        """Wait for a moment, or until units have ended; return these."""
        ...

    def close(self) -> None:
        """End what is still running; it can be gone on with later."""
        ...


class UnitsFailedError(RuntimeError):
    """Some units failed; the others are done."""


def run_units(units: Sequence[Unit], store: Store, executor: Executor, progress: Progress) -> None:
    """Do all units that are not done yet.

    A unit that fails does not keep those from being done that do without it.

    Args:
        units: none before those that it needs.
        store: where their files are.
        executor: where they run.
        progress: told of every unit that starts or ends.

    Raises:
        RequestError: a unit says that the request was wrong.
        UnitsFailedError: units failed, all others are done.
    """
    known = {unit.key: unit for top in units for unit in (*top.needs, top)}
    done = {key for key, unit in known.items() if store.is_done(unit)}
    waiting = [unit for unit in units if unit.key not in done]
    running: set[str] = set()
    failed: list[str] = []
    while waiting or running:
        for unit in _ready(waiting, done):
            if executor.has_room(unit):
                executor.start(unit)
                progress.started(unit)
                running.add(unit.key)
                waiting.remove(unit)
        if not running:
            raise ValueError(f"{waiting[0].folder} needs units that are neither done nor given")
        for outcome in executor.wait():
            running.remove(outcome.unit.key)
            progress.ended(outcome.unit, _seconds(store, outcome))
            if outcome.code == EXIT_WRONG_REQUEST:
                raise RequestError(f"{outcome.unit.kind} {outcome.unit.name}: {outcome.problem}")
            if not outcome.problem:
                done.add(outcome.unit.key)
                continue
            logger.error("%s %s failed: %s", outcome.unit.kind, outcome.unit.name, outcome.problem)
            failed.append(f"{outcome.unit.kind} {outcome.unit.name}")
            waiting = _without_dependents(waiting, outcome.unit)
        progress.show()
    if failed:
        raise UnitsFailedError(
            f"{len(failed)} units failed, the first of them {failed[0]}; everything that does "
            "without them is done, and the same command tries them again"
        )


def _ready(waiting: Sequence[Unit], done: set[str]) -> list[Unit]:
    return [unit for unit in waiting if all(need.key in done for need in unit.needs)]


def _without_dependents(waiting: Sequence[Unit], failed: Unit) -> list[Unit]:
    """Leave out what can no longer be done."""
    lost = {failed.key}
    kept: list[Unit] = []
    for unit in waiting:
        if any(need.key in lost for need in unit.needs):
            lost.add(unit.key)
        else:
            kept.append(unit)
    return kept


def _seconds(store: Store, outcome: Outcome) -> float | None:
    note = store.note(outcome.unit)
    return None if note is None else float(note["seconds"])
