"""Means and rates with 95 % intervals.

Legend: N values, R training seeds, E evaluation seeds, B resamples.

Episodes of one training run are independent: their success rate has Wilson's interval. Episodes of
several are not, because the runs share evaluation seeds: both kinds of seeds are resampled then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.outcomes import Floats
from robo_manip_baselines.rollout.results import CONFIDENCE, Proportion

RESAMPLES = 9999
"""of each bootstrap: the ends of an interval repeat to about a fiftieth of its width."""


@dataclass(frozen=True)
class Estimate:
    """Mean with its interval.

    Attributes:
        mean: None without any value.
        low, high: ends of the 95 % interval; None without enough values.
        n: number of values.
    """

    mean: float | None
    low: float | None
    high: float | None
    n: int


def mean_estimate(grid: Floats, rng: np.random.Generator, resamples: int = RESAMPLES) -> Estimate:
    """Return the mean of a grid, with the bootstrap that fits its number of training seeds.

    Args:
        grid: (R, E), NaN where there is no value.
        rng: of the resampling.
        resamples: B.
    """
    if np.isfinite(grid).any(axis=1).sum() > 1:
        return hierarchical_mean(grid, rng, resamples)
    return bootstrap_mean(grid[np.isfinite(grid)], rng, resamples)


def rate_estimate(grid: Floats, rng: np.random.Generator, resamples: int = RESAMPLES) -> Proportion:
    """Return the rate of ones in a grid, with the interval that fits its number of training seeds.

    Wilson's for one training seed, the hierarchical bootstrap for several. Where all outcomes are
    the same there is nothing to resample: the interval is then Wilson's for a single run.

    Args:
        grid: (R, E) 1, 0 or NaN.
        rng: of the resampling.
        resamples: B.
    """
    is_there = np.isfinite(grid)
    count, n = int(np.nansum(grid)), int(is_there.sum())
    if is_there.any(axis=1).sum() < 2:
        return Proportion.of(count, n)
    if count in (0, n):
        columns = int(is_there.any(axis=0).sum())
        single = Proportion.of(columns if count else 0, columns)
        return replace(single, count=count, rate=count / n)
    found = hierarchical_mean(grid, rng, resamples)
    return Proportion(count, found.mean, found.low, found.high)


def bootstrap_mean(
    values: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Return the mean of independent values with its bias-corrected and accelerated interval.

    One value has no interval. Values that are all the same have an interval of no width.

    Args:
        values: (N,).
        rng: of the resampling.
        resamples: B.
    """
    n = values.size
    if n == 0:
        return Estimate(None, None, None, 0)
    mean = float(values.mean())
    if n == 1:
        return Estimate(mean, None, None, 1)
    if np.ptp(values) == 0.0:
        return Estimate(mean, mean, mean, n)
    from scipy.stats import bootstrap  # slow to import

    found: Any = bootstrap(
        (values,),
        np.mean,
        n_resamples=resamples,
        batch=1000,
        confidence_level=CONFIDENCE,
        method="BCa",
        rng=rng,
    )
    low, high = found.confidence_interval
    return Estimate(mean, float(low), float(high), n)


def hierarchical_mean(
    grid: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Return the mean over training and evaluation seeds, with an interval for both.

    The percentile interval of `hierarchical_means`. With few training seeds it is too narrow: a
    sample of R seeds has about (R - 1)/R of their variance.
    """
    n = int(np.isfinite(grid).sum())
    if n < 2:
        return bootstrap_mean(grid[np.isfinite(grid)], rng, resamples)
    means = hierarchical_means(grid, rng, resamples)
    tail = 50.0 * (1.0 - CONFIDENCE)
    # A resample may hit gaps only; it has no mean.
    low, high = np.nanpercentile(means, [tail, 100.0 - tail])
    return Estimate(float(np.nanmean(grid)), float(low), float(high), n)


def hierarchical_means(grid: Floats, rng: np.random.Generator, resamples: int) -> Floats:
    """Resample training seeds, then the evaluation seeds that they share, and take means.

    All training seeds of a resample share its evaluation seeds, as they do in the data: an easy
    episode is easy for all of them.

    Args:
        grid: (R, E), NaN where there is no value.
        rng: of the resampling.
        resamples: B.

    Returns:
        (B,) means; NaN for a resample without any value.
    """
    R, E = grid.shape
    # Counts of each seed are enough: the order does not matter to a mean.
    rows_BR = rng.multinomial(R, np.full(R, 1.0 / R), size=resamples).astype(np.float64)
    columns_BE = rng.multinomial(E, np.full(E, 1.0 / E), size=resamples).astype(np.float64)
    is_there = np.isfinite(grid)
    sums_B = np.einsum("be,be->b", rows_BR @ np.where(is_there, grid, 0.0), columns_BE)
    counts_B = np.einsum("be,be->b", rows_BR @ is_there.astype(np.float64), columns_BE)
    return np.divide(sums_B, counts_B, out=np.full(resamples, np.nan), where=counts_B > 0)
