"""Intervals and tests against figures worked out by hand and against slow, obvious formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robo_manip_baselines.benchmark.statistics.inference import (
    NO_COMPARISON,
    Comparison,
    Estimate,
    bootstrap_mean,
    clustered_mean,
    hierarchical_mean,
    hierarchical_means,
    holm,
    mean_estimate,
    paired_success,
    paired_times,
    published_success,
    published_time,
    rate_estimate,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import STUDY
from robo_manip_baselines.envs.mujoco.tasks.registry import PublishedResult
from robo_manip_baselines.rollout.results import Proportion

NAN = np.nan


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


# Means of one training run.


def test_bootstrap_of_normal_values_is_the_textbook_interval() -> None:
    values = rng().normal(4.5, 0.6, 400)
    found = bootstrap_mean(values, rng(1))
    assert found.mean == pytest.approx(values.mean())
    error = values.std(ddof=1) / math.sqrt(400)
    # 9999 resamples place an end to within about 0.03 standard errors.
    assert found.low == pytest.approx(values.mean() - 1.96 * error, abs=0.15 * error)
    assert found.high == pytest.approx(values.mean() + 1.96 * error, abs=0.15 * error)


def test_bias_is_corrected() -> None:
    values = rng(3).exponential(1.0, 30)  # skewed: the right end is farther away
    found = bootstrap_mean(values, rng(1))
    assert found.low is not None
    assert found.high is not None
    assert found.high - values.mean() > 1.2 * (values.mean() - found.low)


def test_degenerate_means() -> None:
    assert bootstrap_mean(np.array([]), rng()) == Estimate(None, None, None, 0)
    assert bootstrap_mean(np.array([4.2]), rng()) == Estimate(4.2, None, None, 1)
    assert bootstrap_mean(np.array([4.2, 4.2, 4.2]), rng()) == Estimate(4.2, 4.2, 4.2, 3)
    assert mean_estimate(np.full((2, 3), NAN), rng()) == Estimate(None, None, None, 0)
    assert mean_estimate(np.empty((0, 0)), rng()) == Estimate(None, None, None, 0)
    two = bootstrap_mean(np.array([4.0, 5.0]), rng())
    assert (two.mean, two.low, two.high) == (4.5, 4.0, 5.0)


# Several training runs.


def oracle_means(grid: np.ndarray, generator: np.random.Generator, resamples: int) -> list[float]:
    R, E = grid.shape
    rows = generator.multinomial(R, [1 / R] * R, size=resamples)
    columns = generator.multinomial(E, [1 / E] * E, size=resamples)
    drawn = [np.repeat(np.repeat(grid, r, 0), c, 1) for r, c in zip(rows, columns, strict=True)]
    return [np.nanmean(d) if np.isfinite(d).any() else NAN for d in drawn]


def test_hierarchical_bootstrap_is_that_of_five_lines() -> None:
    grid = rng().normal(size=(3, 20))
    grid[rng(1).random((3, 20)) < 0.4] = NAN
    found = hierarchical_means(grid, rng(2), 200)
    np.testing.assert_allclose(found, oracle_means(grid, rng(2), 200), rtol=1e-12)


def test_resamples_without_a_value_say_nothing() -> None:
    grid = np.full((2, 4), NAN)
    grid[0, 0], grid[1, 1] = 4.0, 6.0
    found = hierarchical_means(grid, rng(2), 300)
    np.testing.assert_allclose(found, oracle_means(grid, rng(2), 300), rtol=1e-12)
    assert np.isnan(found).any()
    estimate = hierarchical_mean(grid, rng(2), 300)
    assert (estimate.mean, estimate.low, estimate.high, estimate.n) == (5.0, 4.0, 6.0, 2)


def test_training_seeds_that_differ_widen_the_interval() -> None:
    alike = np.tile(rng().random(100) < 0.6, (3, 1)).astype(float)
    unlike = np.zeros((3, 100))
    for row, rate in enumerate((0.4, 0.6, 0.8)):
        unlike[row, : round(100 * rate)] = 1.0
    width = []
    for grid in (alike, unlike):
        found = hierarchical_mean(grid, rng(1))
        assert found.low is not None
        assert found.high is not None
        width.append(found.high - found.low)
    assert width[1] > 1.5 * width[0]
    # Runs that agree everywhere are worth no more than one of them.
    once = bootstrap_mean(alike[0], rng(1))
    assert once.low is not None
    assert once.high is not None
    assert width[0] == pytest.approx(once.high - once.low, rel=0.1)


# People.


def oracle_cluster_means(
    grid: np.ndarray, people: list[str], generator: np.random.Generator, resamples: int
) -> np.ndarray:
    R, names = len(grid), sorted(set(people))
    rows = generator.multinomial(R, [1 / R] * R, size=resamples)
    drawn = generator.multinomial(len(names), [1 / len(names)] * len(names), size=resamples)
    counts = np.zeros((resamples, len(people)), dtype=int)
    for place, name in enumerate(names):
        own = [e for e, person in enumerate(people) if person == name]
        counts[:, own] = generator.multinomial(
            drawn[:, place] * len(own), [1 / len(own)] * len(own)
        )
    return np.array(
        [
            np.nanmean(np.repeat(np.repeat(grid, r, 0), c, 1))
            for r, c in zip(rows, counts, strict=True)
        ]
    )


def test_the_bootstrap_over_people_is_that_of_a_few_lines() -> None:
    grid = rng().normal(size=(3, 24))
    grid[1, 3:5] = NAN
    people = [f"person {e % 5}" for e in range(24)]
    found = clustered_mean(grid, people, rng(2), 400)
    means = oracle_cluster_means(grid, people, rng(2), 400)
    assert found.mean == pytest.approx(np.nanmean(grid))
    assert [found.low, found.high] == pytest.approx(np.percentile(means, [2.5, 97.5]).tolist())
    assert found.n == 5


def test_people_who_differ_widen_the_interval() -> None:
    people = [f"person {e % 5}" for e in range(100)]
    alike, unlike = rng().normal(size=(1, 100)), rng().normal(size=(1, 100))
    unlike += 3.0 * np.arange(5)[np.arange(100) % 5]
    widths = []
    for grid in (alike, unlike):
        found = clustered_mean(grid, people, rng(1))
        plain = mean_estimate(grid, rng(1))
        assert None not in (found.low, found.high, plain.low, plain.high)
        widths.append((found.high - found.low) / (plain.high - plain.low))  # type: ignore[operator]
    assert widths[0] < 1.6
    # Means of people have a variance of 3² · 2 beside 1 / 20; P = 5 of them, of episodes 100.
    assert widths[1] == pytest.approx(math.sqrt(18.05 / 5 / ((18 + 1) / 100)), rel=0.1)


def test_everybody_with_one_episode_is_the_bootstrap_over_episodes() -> None:
    grid = rng().normal(size=(1, 60))
    found, plain = (
        clustered_mean(grid, list(map(str, range(60))), rng(1)),
        mean_estimate(grid, rng(1)),
    )
    assert found.low == pytest.approx(plain.low, abs=0.02)
    assert found.high == pytest.approx(plain.high, abs=0.02)


def test_fewer_than_two_people_have_no_interval() -> None:
    grid = rng().random((1, 4))
    assert clustered_mean(grid, ["me"] * 4, rng()) == Estimate(grid.mean(), None, None, 1)
    assert clustered_mean(grid * NAN, ["me"] * 4, rng()) == Estimate(None, None, None, 0)
    grid[0, :3] = NAN  # the other has no value
    assert clustered_mean(grid, ["me", "me", "me", "you"], rng()).n == 1
    assert clustered_mean(np.empty((0, 0)), [], rng()) == Estimate(None, None, None, 0)


def test_no_difference_between_few_people_is_no_evidence() -> None:
    values = np.ones((1, 100))
    people = ["a", "b", "c", "d"] * 25
    over_people = paired_success(values, values, rng(), people=people).over_people
    assert over_people is not None
    assert over_people.high == pytest.approx(1 - 0.025 ** (1 / 4))
    alone = paired_success(values, values, rng(), people=["a"] * 100).over_people
    assert alone == Estimate(0.0, None, None, 1)


def test_one_training_seed_takes_the_plain_bootstrap() -> None:
    values = rng().random((1, 30))
    assert mean_estimate(values, rng(1)) == bootstrap_mean(values[0], rng(1))
    gaps = np.vstack([values, np.full((1, 30), NAN)])  # the other run has no value at all
    assert mean_estimate(gaps, rng(1)) == bootstrap_mean(values[0], rng(1))


@given(
    arrays(
        np.float64,
        st.tuples(st.integers(1, 3), st.integers(1, 6)),
        elements=st.one_of(st.just(NAN), st.floats(-5.0, 5.0)),
    )
)
def test_an_interval_lies_among_the_values(grid: np.ndarray) -> None:
    found = mean_estimate(grid, rng(), 50)
    assert found.n == np.isfinite(grid).sum()
    if found.n == 0:
        assert found.mean is None
        return
    slack = 1e-9
    assert found.mean == pytest.approx(np.nanmean(grid))
    assert (found.low is None) == (found.high is None) == (found.n == 1)
    if found.low is not None and found.high is not None:
        assert np.nanmin(grid) - slack <= found.low <= found.high <= np.nanmax(grid) + slack


def test_rates() -> None:
    one = np.array([[1.0] * 37 + [0.0] * 13])
    assert rate_estimate(one, rng()) == Proportion.of(37, 50)
    z2 = 1.959963984540054**2
    # Wilson for 0 of n ends at z²/(n + z²).
    assert rate_estimate(0 * one, rng()).high == pytest.approx(z2 / (50 + z2))
    two = np.vstack([one, one])
    found, mean = rate_estimate(two, rng(1)), hierarchical_mean(two, rng(1))
    assert (found.count, found.rate) == (74, 0.74)
    assert (found.low, found.high) == (mean.low, mean.high)
    # Nothing to resample: as sure as a single run may be, and no surer.
    sure = rate_estimate(np.ones((3, 50)), rng())
    assert (sure.count, sure.rate) == (150, 1.0)
    assert (sure.low, sure.high) == (pytest.approx(50 / (50 + z2)), pytest.approx(1.0))
    never = rate_estimate(np.zeros((3, 50)), rng())
    assert (never.rate, never.high) == (0.0, pytest.approx(z2 / (50 + z2)))
    assert rate_estimate(np.full((2, 3), NAN), rng()).rate is None


# Pairs.


def pairs(both: int, wins: int, losses: int, neither: int) -> tuple[np.ndarray, np.ndarray]:
    ours = [1.0] * both + [1.0] * wins + [0.0] * losses + [0.0] * neither
    theirs = [1.0] * both + [0.0] * wins + [1.0] * losses + [0.0] * neither
    return np.array([ours]), np.array([theirs])


def test_mcnemar_by_hand() -> None:
    found = paired_success(*pairs(30, 12, 3, 5), rng(), 500)
    # 2 · (1 + 15 + 105 + 455) / 2^15
    assert found.p == pytest.approx(1152 / 32768)
    assert (found.wins, found.losses) == (12, 3)
    assert found.difference.mean == pytest.approx(9 / 50)
    assert found.difference.n == 50
    assert paired_success(*pairs(0, 5, 5, 0), rng(), 500).p == 1.0
    mirrored = paired_success(*pairs(30, 3, 12, 5), rng(), 500)
    assert mirrored.p == found.p
    assert mirrored.difference.mean == pytest.approx(-9 / 50)


def test_interval_of_a_difference_is_that_of_pairs() -> None:
    d = paired_success(*pairs(30, 12, 3, 5), rng()).difference
    # Standard error of b - c over n: sqrt(b + c - (b - c)²/n) / n.
    error = math.sqrt(15 - 81 / 50) / 50
    # Differences are whole fiftieths: the ends of the bootstrap are too.
    assert d.low == pytest.approx(0.18 - 1.96 * error, abs=0.021)
    assert d.high == pytest.approx(0.18 + 1.96 * error, abs=0.021)


def test_conditions_without_a_differing_episode() -> None:
    found = paired_success(*pairs(20, 0, 0, 30), rng(), 500)
    assert found.p == 1.0
    assert found.difference.mean == 0.0
    # Clopper-Pearson, two-sided, for 0 of 50: 1 - 0.025^(1/50).
    assert found.difference.high == pytest.approx(1.0 - 0.025 ** (1 / 50))
    assert found.difference.low == -found.difference.high


def test_no_pairs() -> None:
    nothing = np.full((1, 3), NAN)
    found = paired_success(nothing, nothing, rng())
    assert found == Comparison(Estimate(None, None, None, 0), None)
    assert paired_times(nothing, nothing, rng()).p is None


def test_gaps_are_no_pairs() -> None:
    ours, theirs = pairs(3, 2, 1, 4)
    gap = np.full((1, 5), NAN)
    wide = [np.hstack([part, gap]) for part in (ours, theirs)]
    assert paired_success(*wide, rng(), 500) == paired_success(ours, theirs, rng(), 500)


def test_wilcoxon_by_hand() -> None:
    theirs = np.array([[4.0, 4.1, 4.2, 4.3, 4.4]])
    ours = theirs - np.array([[0.02, 0.04, 0.06, 0.08, 0.1]])
    found = paired_times(ours, theirs, rng(), 500)
    assert found.p == pytest.approx(2 / 2**5)  # all of 5 signs alike
    assert found.difference.mean == pytest.approx(-0.06)
    same = paired_times(theirs, theirs + 1e-12, rng(), 500)
    assert same.p == 1.0


# The paper.


def test_fishers_exact_test_sums_what_is_no_likelier() -> None:
    paper = STUDY.published["baseline"]
    total, hits = 60 + STUDY.trials, 40 + paper.successes
    chance = [
        math.comb(60, k) * math.comb(STUDY.trials, hits - k) / math.comb(total, hits)
        for k in range(max(0, hits - STUDY.trials), min(60, hits) + 1)
    ]
    seen = chance[40 - max(0, hits - STUDY.trials)]
    found = published_success(Proportion.of(40, 60), 60, paper, STUDY.trials)
    assert found.p == pytest.approx(sum(p for p in chance if p <= seen * (1 + 1e-9)))
    assert found.difference.mean == pytest.approx(40 / 60 - 0.42)


@pytest.mark.parametrize(("count", "total"), [(40, 60), (0, 50), (200, 200)])
def test_newcombes_interval_is_made_of_wilsons(count: int, total: int) -> None:
    paper = STUDY.published["current"]
    a, b = Proportion.of(count, total), Proportion.of(paper.successes, STUDY.trials)
    assert None not in (a.rate, a.low, a.high, b.rate, b.low, b.high)
    d = a.rate - b.rate  # type: ignore[operator]
    low = d - math.hypot(a.rate - a.low, b.high - b.rate)  # type: ignore[operator]
    high = d + math.hypot(a.high - a.rate, b.rate - b.low)  # type: ignore[operator]
    found = published_success(Proportion.of(count, total), total, paper, STUDY.trials).difference
    assert (found.low, found.high) == pytest.approx((low, high))


def test_nothing_beside_the_paper() -> None:
    assert published_success(Proportion.of(1, 2), 2, None, 0) == NO_COMPARISON
    assert published_time(np.array([4.0]), None, 0.0) == NO_COMPARISON
    assert (
        published_success(Proportion.of(0, 0), 0, STUDY.published["current"], STUDY.trials).p
        is None
    )
    assert (
        published_time(np.array([NAN]), STUDY.published["current"], STUDY.time_rounding).p is None
    )
    once = published_time(np.array([4.0]), STUDY.published["current"], STUDY.time_rounding)
    assert (once.difference.mean, once.p) == (pytest.approx(-0.6), None)


def test_times_beside_the_paper() -> None:
    times = np.array([4.0, 4.4, 4.8, NAN])  # mean 4.4, standard deviation 0.4
    paper = PublishedResult(successes=3, completion_time=5.05)
    found = published_time(times, paper, STUDY.time_rounding)
    error = 0.4 * math.sqrt(2 / 3)
    # t with 4 degrees of freedom: two-sided tail (1 - x)/1, x = t (t² + 6) / (t² + 4)^1.5.
    t = (0.65 - 0.05) / error
    assert found.p == pytest.approx(1.0 - t * (t * t + 6.0) / (t * t + 4.0) ** 1.5)
    half = 2.776445 * error + 0.05  # t table: 4 degrees of freedom, 0.975
    assert found.difference.mean == pytest.approx(-0.65)
    assert (found.difference.low, found.difference.high) == pytest.approx(
        (-0.65 - half, -0.65 + half), abs=1e-5
    )
    # No farther than the rounding.
    near = published_time(times, PublishedResult(3, 4.44), STUDY.time_rounding)
    assert near.p == 1.0


def corrected(*p_values: float | None) -> list[float | None]:
    return [c.p_holm for c in holm([replace(NO_COMPARISON, p=p) for p in p_values])]


def test_holm_by_hand() -> None:
    # Smallest first: 3 · 0.01, 2 · 0.03, 1 · 0.04, and never below the one before.
    assert corrected(0.01, 0.04, 0.03) == pytest.approx([0.03, 0.06, 0.06])
    assert corrected(None, 0.01, None, 0.6) == [None, pytest.approx(0.02), None, pytest.approx(0.6)]
    assert corrected(0.9, 0.8) == [1.0, 1.0]
    assert corrected(None) == [None]
    assert corrected() == []
