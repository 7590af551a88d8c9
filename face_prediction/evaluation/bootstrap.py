"""Bootstrap intervals over sequences that come in clusters, one for each person.

Sequences of one person resemble one another; resampling them as if they were independent makes
intervals too narrow. Here people are drawn with replacement, and then, for each draw of a person,
as many of the person's sequences as there are, with replacement (Davison and Hinkley 1997, 3.8;
``scipy.stats.bootstrap`` has no clusters).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError


@dataclass(frozen=True)
class Interval:
    """An estimate with its percentile interval; arrays of the statistic's shape."""

    estimate: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    #: people: with one the interval says nothing of others, with a handful little
    clusters: int


def cluster_bootstrap(
    values: NDArray[np.floating],
    subjects: Sequence[str],
    statistic: Callable[[NDArray[np.floating]], NDArray[np.floating] | float] | None = None,
    *,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Percentile interval of ``statistic`` over resampled people and sequences.

    Args:
        values: (N, ...) one row a sequence. Models that are compared stand side by side in a row,
            so that every resample holds the same sequences of both.
        subjects: N names.
        statistic: function of resampled rows; None: their mean, NaN left out.
        level: share of resamples inside the interval.
        resamples: how many.
        seed: of the resampling.

    Raises:
        RequestError: no rows, not one subject a row, or a level or number out of range.
    """
    if len(values) == 0 or len(values) != len(subjects):
        raise RequestError(f"{len(subjects)} subjects for {len(values)} sequences; one for each")
    if not 0 < level < 1:
        raise RequestError(f"level {level}; must be between 0 and 1")
    of_rows = _mean if statistic is None else statistic
    drawn = np.array(
        [of_rows(values[rows]) for rows in _draws(subjects, resamples, seed)], dtype=np.float64
    )
    low, high = percentile_bounds(drawn, level)
    estimate = np.asarray(of_rows(values), dtype=np.float64)
    return Interval(estimate, low, high, len(set(subjects)))


def resample_counts(
    subjects: Sequence[str], *, resamples: int = 2000, seed: int = 0
) -> NDArray[np.int64]:
    """How often (resamples, N) each sequence is in the resamples of `cluster_bootstrap`.

    For statistics that weights are enough for, all resamples at once.

    Args:
        subjects: N names.
        resamples: how many.
        seed: of the resampling.

    Raises:
        RequestError: no rows, or a number out of range.
    """
    if not subjects:
        raise RequestError("no sequences to resample")
    draws = _draws(subjects, resamples, seed)
    return np.stack([np.bincount(rows, minlength=len(subjects)) for rows in draws])


def percentile_bounds(
    drawn: NDArray[np.floating], level: float = 0.95
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper bounds (...) of the middle ``level`` of resampled statistics (W, ...).

    NaN where no resample has a number.
    """
    tail = (1 - level) / 2
    nothing = np.isnan(drawn).all(axis=0)
    bounds = np.nanquantile(np.where(nothing, 0.0, drawn), [tail, 1 - tail], axis=0)
    low, high = np.where(nothing, np.nan, bounds)
    return low, high


def _draws(subjects: Sequence[str], resamples: int, seed: int) -> Iterator[NDArray[np.intp]]:
    """Drawn rows, resample by resample."""
    if resamples < 1 or seed < 0:
        raise RequestError(f"{resamples} resamples with seed {seed}; 1 or more, and 0 or more")
    number = np.unique(np.asarray(subjects), return_inverse=True)[1]
    order, sizes = np.argsort(number, kind="stable"), np.bincount(number)
    rng = np.random.default_rng(seed)
    for _ in range(resamples):
        yield order[_resample(sizes, rng)]


def _resample(sizes: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.intp]:
    """Places of drawn sequences, where those of each person (``sizes``) lie side by side."""
    people = rng.integers(len(sizes), size=len(sizes))
    drawn = sizes[people]
    first = np.repeat((np.cumsum(sizes) - sizes)[people], drawn)
    return first + rng.integers(np.repeat(drawn, drawn))


def _mean(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    there = ~np.isnan(rows)
    total = np.where(there, rows, 0.0).sum(axis=0, dtype=np.float64)
    count = there.sum(axis=0)
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)
