"""Arms against one another on common seeds, and against the paper's counts.

Legend: R training seeds, E evaluation seeds that both arms have.

Tests give None where there is nothing to test; `holm` passes that on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.intervals import (
    RESAMPLES,
    Estimate,
    mean_estimate,
)
from robo_manip_baselines.benchmark.statistics.outcomes import Floats
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import TIME_ROUNDING, TRIALS, PaperResult
from robo_manip_baselines.rollout.results import CONFIDENCE

SIGNIFICANCE = round(1.0 - CONFIDENCE, 9)
"""A smaller p-value, after Holm's correction, is called a difference."""


@dataclass(frozen=True)
class PairedSuccess:
    """Success of an arm against another's, episode by episode.

    Attributes:
        difference: of the rates, this arm minus the other.
        wins: episodes that only this arm managed.
        losses: episodes that only the other arm managed.
        p: of McNemar's exact test.
    """

    difference: Estimate
    wins: int
    losses: int
    p: float | None


@dataclass(frozen=True)
class PairedTimes:
    """Completion times of an arm against another's, over episodes that both managed.

    Attributes:
        difference: s, mean of this arm minus the other.
        p: of Wilcoxon's signed-rank test.
    """

    difference: Estimate
    p: float | None


@dataclass(frozen=True)
class PaperSuccess:
    """Success of an arm against the paper's count.

    Attributes:
        paper: what the paper reports.
        difference: our rate minus the paper's, with Newcombe's interval.
        p: of Fisher's exact test on the two counts.
    """

    paper: PaperResult
    difference: Estimate
    p: float | None


@dataclass(frozen=True)
class PaperTime:
    """Completion time of an arm against the paper's mean.

    Attributes:
        paper: what the paper reports.
        difference: s, our mean minus the paper's.
        p: of Student's t-test, see ``time_against_paper``.
    """

    paper: PaperResult
    difference: Estimate
    p: float | None


def paired_success(
    ours: Floats, theirs: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> PairedSuccess:
    """Compare successes.

    The interval is a bootstrap over the common seeds, hierarchical with several training seeds.
    Where no episode tells the arms apart, a bootstrap would claim to know the difference exactly;
    the interval is then that of Clopper and Pearson for a kind of episode seen 0 times in n,
    in both directions.

    McNemar's test is about the policies that were trained: with several training seeds it takes
    them as they are, and says nothing about others.

    Args:
        ours: (R, E) 1, 0 or NaN.
        theirs: (R, E), NaN in the same places.
        rng: of the resampling.
        resamples: of the bootstrap.
    """
    difference = mean_estimate(ours - theirs, rng, resamples)
    wins, losses = int((ours > theirs).sum()), int((ours < theirs).sum())
    if difference.n == 0:
        return PairedSuccess(difference, wins, losses, None)
    from statsmodels.stats.contingency_tables import mcnemar  # slow to import

    if wins == losses == 0:
        difference = not_seen(difference)
    both = int(((ours == 1.0) & (theirs == 1.0)).sum())
    neither = difference.n - both - wins - losses
    test: Any = mcnemar([[both, wins], [losses, neither]], exact=True)
    return PairedSuccess(difference, wins, losses, float(test.pvalue))


def not_seen(difference: Estimate) -> Estimate:
    """Return a difference of rates that no episode showed with Clopper and Pearson's bounds."""
    from statsmodels.stats.proportion import proportion_confint  # slow to import

    ends: Any = proportion_confint(0, difference.n, alpha=SIGNIFICANCE, method="beta")
    return replace(difference, low=-float(ends[1]), high=float(ends[1]))


def paired_times(
    ours: Floats, theirs: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> PairedTimes:
    """Compare completion times over the episodes that both arms managed.

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
    if not differences.size:
        return PairedTimes(estimate, None)
    if not differences.any():
        return PairedTimes(estimate, 1.0)
    from scipy.stats import wilcoxon  # slow to import

    test: Any = wilcoxon(differences, zero_method="pratt")
    return PairedTimes(estimate, float(test.pvalue))


def against_paper(successes: int, episodes: int, paper: PaperResult) -> PaperSuccess:
    """Compare a count with the paper's.

    Args:
        successes: ours.
        episodes: ours.
        paper: theirs, of ``TRIALS``.
    """
    if not episodes:
        return PaperSuccess(paper, Estimate(None, None, None, 0), None)
    from scipy.stats import fisher_exact  # slow to import
    from statsmodels.stats.proportion import confint_proportions_2indep

    counts = [
        [successes, episodes - successes],
        [paper.successes, TRIALS - paper.successes],
    ]
    test: Any = fisher_exact(counts)
    ends: Any = confint_proportions_2indep(
        successes,
        episodes,
        paper.successes,
        TRIALS,
        method="newcomb",
        compare="diff",
        alpha=SIGNIFICANCE,
    )
    difference = successes / episodes - paper.rate
    return PaperSuccess(
        paper, Estimate(difference, float(ends[0]), float(ends[1]), episodes), float(test.pvalue)
    )


def time_against_paper(times: Floats, paper: PaperResult) -> PaperTime:
    """Compare a mean completion time with the paper's, which comes without a spread.

    The paper's times are taken to spread as ours do, over as many successes as its Table IV says:
    Student's t-test from means and standard deviations. Half of the last digit that the paper gives
    is allowed for on both sides.

    Args:
        times: s, any shape, NaN without success.
        paper: theirs.
    """
    found = times[np.isfinite(times)]
    n = found.size
    if not n:
        return PaperTime(paper, Estimate(None, None, None, 0), None)
    difference = float(found.mean()) - paper.completion_time
    deviation = float(found.std(ddof=1)) if n > 1 else 0.0
    if deviation == 0.0:
        return PaperTime(paper, Estimate(difference, None, None, n), None)
    from scipy.stats import t, ttest_ind_from_stats  # slow to import

    error = deviation * math.sqrt(1.0 / n + 1.0 / paper.successes)
    half = float(t.ppf(0.5 + CONFIDENCE / 2.0, n + paper.successes - 2)) * error + TIME_ROUNDING
    least = max(abs(difference) - TIME_ROUNDING, 0.0)
    test: Any = ttest_ind_from_stats(least, deviation, n, 0.0, deviation, paper.successes)
    estimate = Estimate(difference, difference - half, difference + half, n)
    return PaperTime(paper, estimate, float(test.pvalue))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p-values for their number (Holm 1979); None stays None and does not count."""
    tested = [p for p in p_values if p is not None]
    if not tested:
        return list(p_values)
    from statsmodels.stats.multitest import multipletests  # slow to import

    found: Any = multipletests(tested, alpha=SIGNIFICANCE, method="holm")
    corrected = iter(found[1].tolist())
    return [None if p is None else next(corrected) for p in p_values]
