"""Conditions compared with one another on common seeds, and with published results.

Legend: R training seeds, E evaluation seeds that both conditions have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.intervals import RESAMPLES, Estimate, mean_estimate
from robo_manip_baselines.benchmark.statistics.outcomes import Floats
from robo_manip_baselines.envs.mujoco.tasks.registry import PublishedResult
from robo_manip_baselines.rollout.results import CONFIDENCE

SIGNIFICANCE = round(1.0 - CONFIDENCE, 9)
"""Holm-corrected p-values below it are called significant."""


@dataclass(frozen=True)
class Comparison:
    """Success rate or mean completion time of a condition against another one.

    Attributes:
        difference: this condition minus the other; rates, or s.
        p: of the test; None without data to test.
        p_holm: Holm-corrected over the conditions of a benchmark; None before that.
        wins: of success rates on common seeds: episodes in which only this condition succeeded.
        losses: likewise, only the other.
    """

    difference: Estimate
    p: float | None
    p_holm: float | None = None
    wins: int = 0
    losses: int = 0


NO_COMPARISON = Comparison(Estimate(None, None, None, 0), None)
"""of a condition that there is nothing to compare with."""


def paired_success(
    ours: Floats, theirs: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Comparison:
    """Compare success rates by McNemar's exact test on pairs of episodes.

    The interval is a bootstrap over the common seeds, hierarchical with several training seeds.
    Without any differing episode, a bootstrap has no width; see `bound_unseen`.

    McNemar's test takes the training runs as given: it is about the trained policies.

    Args:
        ours: (R, E) 1, 0 or NaN.
        theirs: (R, E), NaN in the same places.
        rng: of the resampling.
        resamples: of the bootstrap.
    """
    difference = mean_estimate(ours - theirs, rng, resamples)
    wins, losses = int((ours > theirs).sum()), int((ours < theirs).sum())
    if difference.n == 0:
        return Comparison(difference, None)
    from statsmodels.stats.contingency_tables import mcnemar  # slow to import

    if wins == losses == 0:
        difference = bound_unseen(difference)
    both = int(((ours == 1.0) & (theirs == 1.0)).sum())
    neither = difference.n - both - wins - losses
    test: Any = mcnemar([[both, wins], [losses, neither]], exact=True)
    return Comparison(difference, float(test.pvalue), wins=wins, losses=losses)


def bound_unseen(difference: Estimate) -> Estimate:
    """Return a difference of rates without any differing episode with Clopper and Pearson's bounds.

    They are those of an event seen 0 times in n, in both directions.
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


def compare_published_success(
    successes: int, episodes: int, published: PublishedResult, trials: int
) -> Comparison:
    """Compare a count with a published one by Fisher's exact test; the interval is Newcombe's.

    Args:
        successes: ours.
        episodes: ours.
        published: theirs.
        trials: theirs.
    """
    if not episodes:
        return NO_COMPARISON
    from scipy.stats import fisher_exact  # slow to import
    from statsmodels.stats.proportion import confint_proportions_2indep

    theirs = published.successes
    test: Any = fisher_exact([[successes, episodes - successes], [theirs, trials - theirs]])
    ends: Any = confint_proportions_2indep(
        *(successes, episodes, theirs, trials),
        method="newcomb",
        compare="diff",
        alpha=SIGNIFICANCE,
    )
    difference = successes / episodes - theirs / trials
    return Comparison(
        Estimate(difference, float(ends[0]), float(ends[1]), episodes), float(test.pvalue)
    )


def compare_published_time(
    times: Floats, published: PublishedResult, rounding: float
) -> Comparison:
    """Compare a mean completion time with a published one that comes without a spread.

    Published times are assumed to spread as ours do, over as many successes as are published:
    Student's t-test from means and standard deviations, with an allowance for rounding.

    Args:
        times: s, any shape, NaN without success.
        published: theirs.
        rounding: s, half of the last digit of published times.
    """
    found = times[np.isfinite(times)]
    n = found.size
    if not n:
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


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p-values for their number (Holm 1979); None stays None and does not count."""
    tested = [p for p in p_values if p is not None]
    if not tested:
        return list(p_values)
    from statsmodels.stats.multitest import multipletests  # slow to import

    found: Any = multipletests(tested, alpha=SIGNIFICANCE, method="holm")
    corrected = iter(found[1].tolist())
    return [None if p is None else next(corrected) for p in p_values]


def correct_comparisons(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Set the Holm-corrected p-values of comparisons of one kind."""
    corrected = holm([comparison.p for comparison in comparisons])
    return [replace(c, p_holm=p) for c, p in zip(comparisons, corrected, strict=True)]
