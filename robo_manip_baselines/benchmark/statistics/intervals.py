"""Means with 95 % intervals.

Legend: N values, R training seeds, E evaluation seeds, B resamples.

Episodes of one training run are independent: their share of successes has Wilson's interval.
Episodes of several are not, for the runs share evaluation seeds: only a bootstrap over both kinds
of seeds is honest then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.outcomes import Floats
from robo_manip_baselines.rollout.results import CONFIDENCE, Share, share

RESAMPLES = 9999
"""of each bootstrap: the ends of an interval repeat to about a fiftieth of its width."""


@dataclass(frozen=True)
class Estimate:
    """A mean with its interval.

    Attributes:
        mean: None without any value.
        low, high: ends of the 95 % interval; None where the data cannot tell.
        n: values that it is the mean of.
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


def rate_estimate(grid: Floats, rng: np.random.Generator, resamples: int = RESAMPLES) -> Share:
    """Return the share of ones in a grid, with the interval that fits its training seeds.

    Wilson's for one training seed, the hierarchical bootstrap for several. Outcomes that are all
    the same leave nothing to resample; they have Wilson's interval of a single run then.

    Args:
        grid: (R, E) 1, 0 or NaN.
        rng: of the resampling.
        resamples: B.
    """
    is_there = np.isfinite(grid)
    count, n = int(np.nansum(grid)), int(is_there.sum())
    if is_there.any(axis=1).sum() < 2:
        return share(count, n)
    if count in (0, n):
        columns = int(is_there.any(axis=0).sum())
        alone = share(columns if count else 0, columns)
        return Share(count, count / n, alone.low, alone.high)
    found = hierarchical_mean(grid, rng, resamples)
    return Share(count, found.mean, found.low, found.high)


def bootstrap_mean(
    values: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Return the mean of independent values with its bias-corrected and accelerated interval.

    One value has no interval. Values that are all the same have an interval of no width: so far as
    the data tell, there is no spread.

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

    The percentile interval of `hierarchical_means`. Where there are few training seeds it is too
    narrow, for R seeds show about (R - 1)/R of their variance.
    """
    n = int(np.isfinite(grid).sum())
    if n < 2:
        return bootstrap_mean(grid[np.isfinite(grid)], rng, resamples)
    means = hierarchical_means(grid, rng, resamples)
    tail = 50.0 * (1.0 - CONFIDENCE)
    # A resample of nothing but gaps says nothing.
    low, high = np.nanpercentile(means, [tail, 100.0 - tail])
    return Estimate(float(np.nanmean(grid)), float(low), float(high), n)


def hierarchical_means(grid: Floats, rng: np.random.Generator, resamples: int) -> Floats:
    """Resample training seeds, then the evaluation seeds that they share, and take means.

    All training seeds of a resample are evaluated on the same resampled evaluation seeds, as they
    were in truth: an easy episode is easy for all of them.

    Args:
        grid: (R, E), NaN where there is no value.
        rng: of the resampling.
        resamples: B.

    Returns:
        (B,) means; NaN for a resample without any value.
    """
    R, E = grid.shape
    # How often each seed is drawn says all: a mean does not know the order.
    rows_BR = rng.multinomial(R, np.full(R, 1.0 / R), size=resamples).astype(np.float64)
    columns_BE = rng.multinomial(E, np.full(E, 1.0 / E), size=resamples).astype(np.float64)
    is_there = np.isfinite(grid)
    sums_B = np.einsum("be,be->b", rows_BR @ np.where(is_there, grid, 0.0), columns_BE)
    counts_B = np.einsum("be,be->b", rows_BR @ is_there.astype(np.float64), columns_BE)
    return np.divide(sums_B, counts_B, out=np.full(resamples, np.nan), where=counts_B > 0)
