"""Statistical inference: means and rates with 95 % intervals, comparisons with tests.

Legend: N values, R training seeds, E evaluation seeds, B resamples.

Episodes of one training run are independent: their success rate has Wilson's interval. Episodes of
several are not, because the runs share evaluation seeds: both kinds of seeds are resampled then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.outcomes import Floats
from robo_manip_baselines.envs.mujoco.tasks.registry import PublishedResult
from robo_manip_baselines.rollout.results import CONFIDENCE, Proportion

RESAMPLES = 9999
"""of each bootstrap: the ends of an interval repeat to about a fiftieth of its width."""


SIGNIFICANCE = round(1.0 - CONFIDENCE, 9)
"""Holm-corrected p-values below it are called significant."""


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


def proportion(values: Floats) -> Proportion:
    """Return the rate of ones in values of any shape (1, 0 or NaN), with Wilson's interval."""
    return Proportion.of(int(np.nansum(values)), int(np.isfinite(values).sum()))


def rate_estimate(grid: Floats, rng: np.random.Generator, resamples: int = RESAMPLES) -> Proportion:
    """Return the rate of ones in a grid, with the interval that fits its number of training seeds.

    Wilson's for one training seed, the hierarchical bootstrap for several. Where all outcomes are
    the same there is nothing to resample: the interval is then Wilson's for a single run.

    Args:
        grid: (R, E) 1, 0 or NaN.
        rng: of the resampling.
        resamples: B.
    """
    is_there, found = np.isfinite(grid), proportion(grid)
    if is_there.any(axis=1).sum() < 2:
        return found
    if found.rate in (0.0, 1.0):
        columns = int(is_there.any(axis=0).sum())
        single = Proportion.of(columns if found.rate else 0, columns)
        return replace(found, low=single.low, high=single.high)
    mean = hierarchical_mean(grid, rng, resamples)
    return Proportion(found.count, mean.mean, mean.low, mean.high)


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
    _, E = grid.shape
    rows_BR = _resampled_rows(grid, rng, resamples)
    columns_BE = rng.multinomial(E, np.full(E, 1.0 / E), size=resamples).astype(np.float64)
    return _resampled_means(grid, rows_BR, columns_BE)


def clustered_mean(
    grid: Floats, people: Sequence[str], rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Return the mean of a grid with an interval over other people, not only over other episodes.

    The percentile interval of a bootstrap that resamples training seeds, then people, then the
    evaluation seeds of each person drawn. With few people it is too narrow: a sample of P people
    has about (P - 1)/P of their variance.

    Args:
        grid: (R, E), NaN where there is no value.
        people: E names, who moved in the episodes of each evaluation seed.
        rng: of the resampling.
        resamples: B.

    Returns:
        The estimate, whose ``n`` is the number of people with a value; without an interval where
        there are fewer than two.
    """
    grid, is_there = grid[np.isfinite(grid).any(axis=1)], np.isfinite(grid).any(axis=0)
    if not is_there.any():
        return Estimate(None, None, None, 0)
    grid = grid[:, is_there]
    names, person_E = np.unique(np.asarray(people)[is_there], return_inverse=True)
    mean, P = float(np.nanmean(grid)), len(names)
    if P < 2:
        return Estimate(mean, None, None, P)
    rows_BR = _resampled_rows(grid, rng, resamples)
    times_BP = rng.multinomial(P, np.full(P, 1.0 / P), size=resamples)
    columns_BE = np.empty((resamples, grid.shape[1]))
    for person, times_B in enumerate(times_BP.T):
        own = np.flatnonzero(person_E == person)
        # Somebody who is drawn twice has episodes drawn twice, independently.
        shares = np.full(len(own), 1.0 / len(own))
        columns_BE[:, own] = rng.multinomial(times_B * len(own), shares)
    means = _resampled_means(grid, rows_BR, columns_BE)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.nanpercentile(means, [tail, 100.0 - tail])
    return Estimate(mean, float(low), float(high), P)


def _resampled_rows(grid: Floats, rng: np.random.Generator, resamples: int) -> Floats:
    """Draw training seeds; return how often each is there, (B, R)."""
    R = len(grid)
    return rng.multinomial(R, np.full(R, 1.0 / R), size=resamples).astype(np.float64)


def _resampled_means(grid: Floats, rows_BR: Floats, columns_BE: Floats) -> Floats:
    """Return means (B,) of a grid (R, E), given how often each row and column is there.

    Counts are enough: the order does not matter to a mean. NaN for a resample without any value.
    """
    is_there = np.isfinite(grid)
    sums_B = np.einsum("be,be->b", rows_BR @ np.where(is_there, grid, 0.0), columns_BE)
    counts_B = np.einsum("be,be->b", rows_BR @ is_there.astype(np.float64), columns_BE)
    return np.divide(sums_B, counts_B, out=np.full(len(sums_B), np.nan), where=counts_B > 0)


@dataclass(frozen=True)
class Comparison:
    """Success rate or mean completion time of a condition against another one.

    Attributes:
        difference: this condition minus the other; rates, or s.
        p: of the test; None without data to test.
        p_holm: Holm-corrected over the conditions of a benchmark; None before that.
        wins: of success rates on common seeds: episodes in which only this condition succeeded.
        losses: likewise, only the other.
        over_people: of success rates: the same difference with the interval of `clustered_mean`;
            ``n`` is the number of people. None where nothing was compared.
    """

    difference: Estimate
    p: float | None
    p_holm: float | None = None
    wins: int = 0
    losses: int = 0
    over_people: Estimate | None = None


NO_COMPARISON = Comparison(Estimate(None, None, None, 0), None)
"""of a condition that there is nothing to compare with."""


def paired_success(
    ours: Floats,
    theirs: Floats,
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    people: Sequence[str] | None = None,
) -> Comparison:
    """Compare success rates by McNemar's exact test on pairs of episodes.

    The interval is a bootstrap over the common seeds, hierarchical with several training seeds;
    given the people, there is another one over them, see `clustered_mean`. Without any differing
    episode, a bootstrap has no width; see `bound_unseen`.

    McNemar's test takes the training runs as given: it is about the trained policies.

    Args:
        ours: (R, E) 1, 0 or NaN.
        theirs: (R, E), NaN in the same places.
        rng: of the resampling.
        resamples: of the bootstrap.
        people: E names, who moved in the episodes of each evaluation seed.
    """
    difference = mean_estimate(ours - theirs, rng, resamples)
    over_people = None
    if people is not None:
        over_people = clustered_mean(ours - theirs, people, rng, resamples)
    wins, losses = int((ours > theirs).sum()), int((ours < theirs).sum())
    if difference.n == 0:
        return Comparison(difference, None, over_people=over_people)
    from statsmodels.stats.contingency_tables import mcnemar  # slow to import

    if wins == losses == 0:
        difference = bound_unseen(difference)
        if over_people is not None and over_people.low is not None:
            over_people = bound_unseen(over_people)
    both = int(((ours == 1.0) & (theirs == 1.0)).sum())
    neither = difference.n - both - wins - losses
    test: Any = mcnemar([[both, wins], [losses, neither]], exact=True)
    return Comparison(
        difference, float(test.pvalue), wins=wins, losses=losses, over_people=over_people
    )


def bound_unseen(difference: Estimate) -> Estimate:
    """Return a difference of rates without any differing episode with Clopper and Pearson's bounds.

    They are those of an event seen 0 times in n, in both directions; n may be that of people.
    """
    from statsmodels.stats.proportion import proportion_confint  # slow to import

    ends: Any = proportion_confint(0, difference.n, alpha=SIGNIFICANCE, method="beta")
    return replace(difference, low=-float(ends[1]), high=float(ends[1]))


def paired_times(
    ours: Floats, theirs: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Comparison:
    """Compare completion times, where both succeeded, by Wilcoxon's signed-rank test.

    Args:
        ours: (R, E) s, NaN without success.
        theirs: (R, E), NaN in the same places.
        rng: of the resampling.
        resamples: of the bootstrap.
    """
    # Times are whole steps of 0.02 s; what floating point adds would break ties.
    grid = np.round(ours - theirs, 6)
    differences = grid[np.isfinite(grid)]
    estimate = mean_estimate(grid, rng, resamples)
    if not differences.any():
        return Comparison(estimate, 1.0 if differences.size else None)
    from scipy.stats import wilcoxon  # slow to import

    test: Any = wilcoxon(differences, zero_method="pratt")
    return Comparison(estimate, float(test.pvalue))


def published_success(
    ours: Proportion, episodes: int, published: PublishedResult | None, trials: int
) -> Comparison:
    """Compare a count with a published one by Fisher's exact test; the interval is Newcombe's.

    Args:
        ours: count of successes.
        episodes: ours.
        published: theirs; None if there is none.
        trials: theirs.
    """
    if ours.rate is None or published is None:
        return NO_COMPARISON
    from scipy.stats import fisher_exact  # slow to import
    from statsmodels.stats.proportion import confint_proportions_2indep

    count, theirs = ours.count, published.successes
    test: Any = fisher_exact([[count, episodes - count], [theirs, trials - theirs]])
    ends: Any = confint_proportions_2indep(
        count, episodes, theirs, trials, "newcomb", "diff", SIGNIFICANCE
    )
    mean = count / episodes - theirs / trials
    return Comparison(Estimate(mean, float(ends[0]), float(ends[1]), episodes), float(test.pvalue))


def published_time(times: Floats, published: PublishedResult | None, rounding: float) -> Comparison:
    """Compare a mean completion time with a published one that comes without a spread.

    Published times are assumed to spread as ours do, over as many successes as are published:
    Student's t-test from means and standard deviations, with an allowance for rounding.

    Args:
        times: s, any shape, NaN without success.
        published: theirs; None if there is none.
        rounding: s, half of the last digit of published times.
    """
    found = times[np.isfinite(times)]
    n = found.size
    if not n or published is None:
        return NO_COMPARISON
    difference = float(found.mean()) - published.completion_time
    deviation = float(found.std(ddof=1)) if n > 1 else 0.0
    if deviation == 0.0:
        return Comparison(Estimate(difference, None, None, n), None)
    from scipy.stats import t, ttest_ind_from_stats  # slow to import

    theirs = published.successes
    error = deviation * math.sqrt(1.0 / n + 1.0 / theirs)
    half = float(t.ppf(0.5 + CONFIDENCE / 2.0, n + theirs - 2)) * error + rounding
    least = max(abs(difference) - rounding, 0.0)
    test: Any = ttest_ind_from_stats(least, deviation, n, 0.0, deviation, theirs)
    return Comparison(
        Estimate(difference, difference - half, difference + half, n), float(test.pvalue)
    )


def holm(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Correct p-values for their number (Holm 1979); those that are None do not count."""
    tested = [c.p for c in comparisons if c.p is not None]
    if not tested:
        return list(comparisons)
    from statsmodels.stats.multitest import multipletests  # slow to import

    found: Any = multipletests(tested, alpha=SIGNIFICANCE, method="holm")
    corrected = iter(found[1].tolist())
    return [c if c.p is None else replace(c, p_holm=next(corrected)) for c in comparisons]
