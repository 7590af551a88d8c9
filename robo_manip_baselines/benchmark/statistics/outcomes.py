"""Result lines and where they stand, so that every figure can be traced to them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.feeding.failure import APPROACH_LIMIT
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Line:
    """A line of a results file.

    Attributes:
        file: path of the file, with forward slashes, as a link from the report spells it.
        number: of the line, from 1.
        result: what it says.
    """

    file: str
    number: int
    result: EpisodeResult


@dataclass(frozen=True)
class Selection:
    """Which result lines a figure comes from. ``None`` selects everything.

    Attributes:
        arm: name of the arm.
        train_seed: of the policy.
        is_success: only successes, or only failures.
        is_strict: only strict successes.
        within: only successes within so many s of the lift.
        failure: only this kind of failure.
        versus: names of other arms; then the lines of all are meant, for training and evaluation
            seeds that all of them have, and that all of them managed where ``is_success``.
        is_different: with ``versus``: only seeds that one arm managed and another did not.
    """

    arm: str
    train_seed: int | None = None
    is_success: bool | None = None
    is_strict: bool | None = None
    within: float | None = None
    failure: str | None = None
    versus: tuple[str, ...] = ()
    is_different: bool = False


def read_lines(files: Iterable[Path], root: Path | None = None) -> tuple[Line, ...]:
    """Read results files of any number of arms; a torn last line is left out.

    Args:
        files: paths of ``results.jsonl`` files.
        root: folder that the paths are told relative to, usually that of the report.

    Raises:
        RequestError: a file is missing or damaged, holds results of another environment, or an
            episode (arm, training seed, seed) is there twice.
    """
    lines: list[Line] = []
    seen: dict[tuple[str, int | None, int], Line] = {}
    for path in files:
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise RequestError(
                f"'{path}' cannot be read: {error.strerror}; name a results.jsonl file"
            ) from error
        name = _relative(path, root)
        for number, content in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
            try:
                line = Line(name, number, EpisodeResult.from_line(content))
            except ValueError as error:
                raise RequestError(
                    f"'{path}', line {number} is damaged: {error}; remove that line"
                ) from error
            key = (line.result.arm, line.result.train_seed, line.result.seed)
            if there := seen.get(key):
                raise RequestError(
                    f"'{path}', line {number}: arm {key[0]}, training seed {key[1]}, seed {key[2]} "
                    f"is also in '{there.file}', line {there.number}; give one of them only"
                )
            seen[key] = line
            lines.append(line)
    environments = sorted({line.result.env for line in lines})
    if len(environments) > 1:
        raise RequestError(
            f"results of {' and '.join(environments)} do not compare; give those of one environment"
        )
    return tuple(lines)


def _relative(path: Path, root: Path | None) -> str:
    """Return a path as a link from a folder would spell it, or as it is."""
    if root is None:
        return path.as_posix()
    return Path(os.path.relpath(path.resolve(), root.resolve())).as_posix()


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
