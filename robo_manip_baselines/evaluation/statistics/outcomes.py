"""Outcomes of an arm as a grid.

Legend: R training seeds, E evaluation seeds. NaN where an episode is missing, and for the time of
an episode without success.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.evaluation.failure import APPROACH_LIMIT
from robo_manip_baselines.evaluation.result import EpisodeResult
from robo_manip_baselines.evaluation.statistics.lines import Line

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What the episodes of one arm came to.

    Attributes:
        train_seeds: R of them, None for a policy that was not trained.
        seeds: E of them, in ascending order.
        success: (R, E) 1 or 0.
        strict: (R, E) likewise, of ``is_success_strict``.
        time: (R, E) s, from the lift to success.
    """

    train_seeds: tuple[int | None, ...]
    seeds: tuple[int, ...]
    success: Floats
    strict: Floats
    time: Floats

    @property
    def in_time(self) -> Floats:
        """(R, E) 1 or 0: success within the time that the paper's Algorithm 1 gives."""
        is_in_time = np.nan_to_num(self.time, nan=np.inf) <= APPROACH_LIMIT
        return np.where(np.isfinite(self.success), is_in_time, np.nan)

    @property
    def episodes(self) -> int:
        """How many there are."""
        return int(np.isfinite(self.success).sum())


def outcomes_of(lines: Sequence[Line]) -> Outcomes:
    """Arrange the result lines of one arm."""
    results = [line.result for line in lines]
    train_seeds = tuple(sorted({r.train_seed for r in results}, key=lambda s: (s is not None, s)))
    seeds = tuple(sorted({r.seed for r in results}))
    rows = {seed: row for row, seed in enumerate(train_seeds)}
    columns = {seed: column for column, seed in enumerate(seeds)}

    def grid(value: Callable[[EpisodeResult], float | None]) -> Floats:
        cells = np.full((len(train_seeds), len(seeds)), np.nan)
        for r in results:
            if (number := value(r)) is not None:
                cells[rows[r.train_seed], columns[r.seed]] = number
        return cells

    return Outcomes(
        train_seeds,
        seeds,
        success=grid(lambda r: r.is_success),
        strict=grid(lambda r: r.is_success_strict),
        time=grid(lambda r: r.completion_time if r.is_success else None),
    )


def on_common_seeds(arms: Sequence[Outcomes], measure: str) -> Floats:
    """Return one grid of several arms, where all of them have it.

    Args:
        arms: A of them.
        measure: ``success``, ``strict`` or ``time``.

    Returns:
        (A, R', E') over the training and evaluation seeds that all arms have; either may be 0. A
        cell that is NaN in one arm is NaN in all.
    """
    rows = [seed for seed in arms[0].train_seeds if all(seed in arm.train_seeds for arm in arms)]
    columns = [seed for seed in arms[0].seeds if all(seed in arm.seeds for arm in arms)]
    grids = np.empty((len(arms), len(rows), len(columns)))
    for grid, arm in zip(grids, arms, strict=True):
        own_rows = [arm.train_seeds.index(seed) for seed in rows]
        own_columns = [arm.seeds.index(seed) for seed in columns]
        grid[:] = getattr(arm, measure)[np.ix_(own_rows, own_columns)]
    return np.where(np.isfinite(grids).all(axis=0), grids, np.nan)
