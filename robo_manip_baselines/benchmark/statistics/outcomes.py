"""Result rows with their place in a file, and the outcomes of a condition as a matrix.

Legend: C conditions, R training seeds, E evaluation seeds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face.motions import SYNTHETIC
from robo_manip_baselines.rollout.agreement import require_one_condition
from robo_manip_baselines.rollout.results import EpisodeResult, read_rows
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

END_POINTS = {"success": "success", "success_strict": "strict"}
"""End point that a benchmark may declare -> its measure in an `OutcomeMatrix`."""


@dataclass(frozen=True)
class ResultRow:
    """Row of a results file and its place.

    Attributes:
        file: path of the file, with forward slashes, as a link from the report has it.
        number: of the row, from 1.
        result: of the episode.
    """

    file: str
    number: int
    result: EpisodeResult


@dataclass(frozen=True)
class RowSelection:
    """Result rows that a number is computed from. ``None`` selects everything.

    Attributes:
        condition: name of the condition.
        train_seed: of the policy.
        is_success: only successes, or only failures.
        is_strict: only strict successes.
        within: only successes with at most this completion time, s.
        failure: only this kind of failure.
        versus: names of other conditions. The rows of all of them are selected then, for training
            and evaluation seeds that all have (and, with ``is_success``, at which all succeeded).
        is_different: with ``versus``: only seeds at which some succeeded and others failed.
        is_strictly_different: likewise, of strict success.
    """

    condition: str
    train_seed: int | None = None
    is_success: bool | None = None
    is_strict: bool | None = None
    within: float | None = None
    failure: str | None = None
    versus: tuple[str, ...] = ()
    is_different: bool = False
    is_strictly_different: bool = False


def read_result_rows(files: Iterable[Path], root: Path | None = None) -> tuple[ResultRow, ...]:
    """Read results files of any number of conditions; a torn last row is left out.

    Args:
        files: paths of ``results.jsonl`` files.
        root: folder that the paths of the rows are relative to, usually that of the report.

    Raises:
        RequestError: a file is missing or damaged, holds results of another environment, or an
            episode (condition, training seed, seed) is there twice.
    """
    seen: dict[tuple[str, int | None, int], ResultRow] = {}
    for path in files:
        name = path if root is None else os.path.relpath(path.resolve(), root.resolve())
        for number, result in enumerate(read_rows(path), start=1):
            row = ResultRow(Path(name).as_posix(), number, result)
            key = (result.condition, result.train_seed, result.seed)
            if there := seen.get(key):
                raise RequestError(
                    f"'{path}', line {number}: condition {key[0]}, training seed {key[1]}, seed "
                    f"{key[2]} is also in '{there.file}', line {there.number}; give one of them "
                    "only"
                )
            seen[key] = row
    environments = sorted({row.result.env for row in seen.values()})
    if len(environments) > 1:
        raise RequestError(
            f"results of {' and '.join(environments)} do not compare; give those of one environment"
        )
    return tuple(seen.values())


@dataclass(frozen=True, eq=False)
class OutcomeMatrix:
    """Outcomes of the episodes of one condition; NaN where there is no episode.

    Attributes:
        train_seeds: R of them, None for a policy that was not trained.
        seeds: E of them, in ascending order.
        success: (R, E) 1 or 0.
        strict: (R, E) likewise, of ``is_success_strict``.
        safe: (R, E) likewise, of ``success_safe``; NaN in rows of earlier releases, too.
        time: (R, E) s, completion times; NaN without success, too.
        people: E of them, who moved in the episodes of each evaluation seed. A synthetic motion is
            another person with every seed.
    """

    train_seeds: tuple[int | None, ...]
    seeds: tuple[int, ...]
    success: Floats
    strict: Floats
    safe: Floats
    time: Floats
    people: tuple[str, ...]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return int(np.isfinite(self.success).sum())

    @property
    def complete_seeds(self) -> set[int]:
        """Evaluation seeds that every training seed has."""
        is_there = np.isfinite(self.success)
        return {seed for column, seed in enumerate(self.seeds) if is_there[:, column].all()}

    def success_within(self, limit: float) -> Floats:
        """Return (R, E) 1 or 0: success with a completion time of at most ``limit`` s."""
        is_within = np.nan_to_num(self.time, nan=np.inf) <= limit
        return np.where(np.isfinite(self.success), is_within, np.nan)


def outcome_matrix(rows: Sequence[ResultRow]) -> OutcomeMatrix:
    """Arrange the result rows of one condition by training and evaluation seed.

    Raises:
        RequestError: they are not all of one condition, or an episode is there twice.
    """
    results = [row.result for row in rows]
    require_one_condition(results)
    train_seeds = sorted_train_seeds(r.train_seed for r in results)
    seeds = tuple(sorted({r.seed for r in results}))

    def matrix(value: Callable[[EpisodeResult], float | None]) -> Floats:
        values = np.full((len(train_seeds), len(seeds)), np.nan)
        for r in results:
            values[row_of[r.train_seed], column_of[r.seed]] = value(r)  # None becomes NaN
        return values

    row_of = {seed: row for row, seed in enumerate(train_seeds)}
    column_of = {seed: column for column, seed in enumerate(seeds)}
    return OutcomeMatrix(
        train_seeds,
        seeds,
        success=matrix(lambda r: r.is_success),
        strict=matrix(lambda r: r.is_success_strict),
        safe=matrix(lambda r: r.success_safe),
        time=matrix(lambda r: r.completion_time if r.is_success else None),
        people=tuple(_people(results)[seed] for seed in seeds),
    )


def _people(results: Iterable[EpisodeResult]) -> dict[int, str]:
    """Map evaluation seeds to the people who moved."""
    return {
        r.seed: f"{SYNTHETIC} {r.seed}" if r.motion_clip == SYNTHETIC else r.motion_subject
        for r in results
    }


def people_on_common_seeds(outcomes: Sequence[OutcomeMatrix]) -> tuple[str, ...]:
    """Return who moved on the seeds that several conditions have, E', see `on_common_seeds`.

    Where conditions differ in their motions, the people of the one with the fewest count.
    """
    people = [dict(zip(own.seeds, own.people, strict=True)) for own in outcomes]
    columns = [s for s in outcomes[0].seeds if all(s in other for other in people)]
    return min(
        (tuple(own[s] for s in columns) for own in people), key=lambda names: len(set(names))
    )


def sorted_train_seeds(seeds: Iterable[int | None]) -> tuple[int | None, ...]:
    """Sort training seeds without repetitions, None first."""
    return tuple(sorted(set(seeds), key=lambda seed: (seed is not None, seed)))


def on_common_seeds(outcomes: Sequence[OutcomeMatrix], measure: str) -> Floats:
    """Return one measure of several conditions on the seeds that all of them have.

    Args:
        outcomes: of C conditions.
        measure: ``success``, ``strict`` or ``time``.

    Returns:
        (C, R', E') over the common training and evaluation seeds; either may be 0. An element that
        is NaN in one condition is NaN in all.
    """
    first = outcomes[0]
    rows = [s for s in first.train_seeds if all(s in other.train_seeds for other in outcomes)]
    columns = [s for s in first.seeds if all(s in other.seeds for other in outcomes)]
    matrices = np.empty((len(outcomes), len(rows), len(columns)))
    for matrix, own in zip(matrices, outcomes, strict=True):
        own_rows = [own.train_seeds.index(seed) for seed in rows]
        own_columns = [own.seeds.index(seed) for seed in columns]
        matrix[:] = getattr(own, measure)[np.ix_(own_rows, own_columns)]
    return np.where(np.isfinite(matrices).all(axis=0), matrices, np.nan)
