"""Doing units as what they need gets done, wherever they run."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from robo_manip_baselines.benchmark.progress import Progress
from robo_manip_baselines.benchmark.store import Store
from robo_manip_baselines.benchmark.unit import Unit
from robo_manip_baselines.command import EXIT_WRONG_REQUEST
from robo_manip_baselines.errors import RequestError

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
