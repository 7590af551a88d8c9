"""Errors of the mouth and of all landmarks, and their intervals, against slow oracles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from face_prediction.evaluation.statistics import bootstrap_mean
from face_prediction.prediction.errors import (
    mouth_distances,
    mouth_errors,
    mouth_residuals,
    normalised_mean_errors,
)
from face_prediction.tracking.geometry import LIPS
from robo_manip_baselines.runs.errors import RequestError


def pair_of_faces(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.2, 0.8, (7, 5, 468, 2))
    return truth + rng.normal(0, 0.01, truth.shape), truth


def test_residual_is_forecast_minus_truth_of_the_lips() -> None:
    forecast, truth = pair_of_faces()
    found = mouth_residuals(forecast, truth)
    for axis in range(2):
        means = [sum(array[3, 2, i, axis] for i in LIPS) / len(LIPS) for array in (forecast, truth)]
        assert found[3, 2, axis] == pytest.approx(means[0] - means[1])
    shifted = truth + np.array([0.01, -0.02])
    np.testing.assert_allclose(mouth_residuals(shifted, truth)[..., 0], 0.01)
    np.testing.assert_allclose(mouth_residuals(shifted, truth)[..., 1], -0.02)


def test_residuals_of_unlike_shapes_are_refused() -> None:
    forecast, truth = pair_of_faces()
    with pytest.raises(RequestError, match=r"\(7, 4, 468, 2\)"):
        mouth_residuals(forecast[:, :4], truth)
    with pytest.raises(RequestError, match="truth"):
        mouth_residuals(forecast, np.full_like(truth, np.nan))


def test_mean_and_variance_of_absolute_errors() -> None:
    # two sequences, two frames; U and V by hand
    residuals = np.array([[[0.1, -0.2], [0.3, 0.0]], [[-0.3, 0.2], [0.3, 0.4]]])
    errors = mouth_errors(residuals)
    np.testing.assert_allclose(errors.mean, [[0.2, 0.2], [0.3, 0.2]])
    np.testing.assert_allclose(errors.variance, [[0.01, 0.0], [0.0, 0.04]], atol=1e-17)
    np.testing.assert_allclose(errors.pooled_mean, [0.25, 0.2])
    # U: 0.1 0.3 0.3 0.3, V: 0.2 0 0.2 0.4
    np.testing.assert_allclose(errors.pooled_variance, [0.0075, 0.02])
    assert errors.forecasts.tolist() == [2, 2]
    assert errors.missing.tolist() == [0, 0]


def test_missing_forecasts_are_counted_and_not_averaged() -> None:
    forecast, truth = pair_of_faces()
    forecast[1, 0] = np.nan
    forecast[2:, 4] = np.nan
    forecast[5, 4, LIPS[0], 0] = np.nan
    errors = mouth_errors(mouth_residuals(forecast, truth))
    assert errors.forecasts.tolist() == [6, 7, 7, 7, 2]
    assert errors.missing.tolist() == [1, 0, 0, 0, 5]
    kept = [0, 2, 3, 4, 5, 6]
    alone = mouth_errors(mouth_residuals(forecast[kept, :1], truth[kept, :1]))
    np.testing.assert_allclose(errors.mean[0], alone.mean[0])
    nothing = mouth_errors(np.full((2, 3, 2), np.nan))
    assert np.all(np.isnan(nothing.mean))
    assert np.all(np.isnan(nothing.pooled_variance))
    assert nothing.missing.tolist() == [2, 2, 2]


@given(hnp.arrays(float, (6, 3, 2), elements=st.floats(-1, 1)))
@settings(max_examples=50, deadline=None)
def test_pooled_is_per_frame_put_together(residuals: np.ndarray) -> None:
    errors = mouth_errors(residuals)
    np.testing.assert_allclose(errors.pooled_mean, errors.mean.mean(axis=0), atol=1e-12)
    # law of total variance
    between = errors.mean.var(axis=0)
    np.testing.assert_allclose(
        errors.pooled_variance, errors.variance.mean(axis=0) + between, atol=1e-12
    )


@pytest.mark.parametrize(
    ("residuals", "told"),
    [
        (np.zeros((3, 2)), "shape"),
        (np.zeros((3, 5, 3)), "shape"),
        (np.zeros((0, 5, 2)), "shape"),
        (np.full((3, 5, 2), np.inf), "infinity"),
    ],
)
def test_wrong_residuals_are_refused(residuals: np.ndarray, told: str) -> None:
    with pytest.raises(RequestError, match=told):
        mouth_errors(residuals)


def test_distance_is_that_of_pythagoras() -> None:
    np.testing.assert_allclose(
        mouth_distances(np.array([[[3.0, -4.0], [np.nan, 0.0]]])), [[5, np.nan]]
    )


def test_nme_is_by_the_outer_corners_of_the_eyes() -> None:
    forecast, truth = pair_of_faces(1)
    found = normalised_mean_errors(forecast, truth)
    assert found.shape == (7, 5)
    total = 0.0
    for i in range(468):
        total += np.hypot(*(forecast[2, 3, i] - truth[2, 3, i]))
    eyes = np.hypot(*(truth[2, 3, 33] - truth[2, 3, 263]))
    assert found[2, 3] == pytest.approx(total / 468 / eyes)
    # in crops or in pixels, it is the same
    np.testing.assert_allclose(normalised_mean_errors(256 * forecast, 256 * truth), found)
    blind = truth.copy()
    blind[0, 0, 263] = blind[0, 0, 33]
    with pytest.raises(RequestError, match="eye"):
        normalised_mean_errors(forecast, blind)
    forecast[1, 1, 7] = np.nan
    assert np.isnan(normalised_mean_errors(forecast, truth)[1, 1])


@pytest.mark.parametrize("subjects", [[f"s{i}" for i in range(80)], ["s"] * 80])
def test_interval_of_independent_rows_is_that_of_scipy(subjects: list[str]) -> None:
    from scipy import stats

    values = np.random.default_rng(2).normal(3.0, 1.0, 80)
    # one row a person leaves the second stage nothing to choose, one person the first
    ours = bootstrap_mean(values, subjects, resamples=4000)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=4000, method="percentile", rng=np.random.default_rng(3)
    ).confidence_interval
    assert float(ours.value) == pytest.approx(values.mean())
    # the ends of 4000 resamples are off by about 0.005, for a standard error of 0.11
    assert float(ours.low) == pytest.approx(theirs.low, abs=0.02)
    assert float(ours.high) == pytest.approx(theirs.high, abs=0.02)


def test_people_widen_the_interval() -> None:
    rng = np.random.default_rng(4)
    people = rng.normal(0, 1, 12)
    subjects = [f"s{i // 40}" for i in range(480)]
    values = np.repeat(people, 40) + rng.normal(0, 0.1, 480)
    ours = bootstrap_mean(values, subjects)
    # the mean of 12 people of standard deviation s has standard error s / sqrt(12)
    expected = 2 * 1.96 * people.std() / np.sqrt(12)
    assert float(ours.high - ours.low) == pytest.approx(expected, rel=0.15)
    each_alone = bootstrap_mean(values, [f"s{i}" for i in range(480)])
    assert float(ours.high - ours.low) > 3 * float(each_alone.high - each_alone.low)


@pytest.mark.long
def test_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    covered = 0
    for trial in range(150):
        people = rng.normal(0, 1, 30)
        values = np.repeat(people, 5) + rng.normal(0, 1, 150)
        subjects = [f"s{i // 5}" for i in range(150)]
        found = bootstrap_mean(values, subjects, level=0.9, resamples=200, seed=trial)
        covered += bool(found.low <= 0 <= found.high)
    # 150 trials at 0.9: standard deviation 3.7; percentile intervals of 30 people fall short a bit
    assert 122 <= covered <= 148


def test_a_resample_holds_whole_rows() -> None:
    rng = np.random.default_rng(6)
    errors = rng.uniform(0.5, 1.5, (60, 5))
    both = np.stack([errors, 2 * errors], axis=-1)  # always half as wrong
    subjects = [f"s{i % 9}" for i in range(60)]
    found = bootstrap_mean(both, subjects)
    for part in (found.value, found.low, found.high):
        assert part.shape == (5, 2)
        np.testing.assert_allclose(part[:, 0] / part[:, 1], 0.5)


def test_interval_repeats_with_its_seed() -> None:
    values, subjects = np.arange(20.0), [f"s{i % 4}" for i in range(20)]
    first, again, other = (
        bootstrap_mean(values, subjects, seed=s, resamples=99) for s in (1, 1, 2)
    )
    assert (first.low, first.high) == (again.low, again.high)
    assert (first.low, first.high) != (other.low, other.high)


def test_rows_without_a_forecast_are_left_out() -> None:
    values = np.array([1.0, np.nan, 3.0, np.nan])
    found = bootstrap_mean(values, ["a", "a", "b", "b"], resamples=200)
    assert float(found.value) == 2.0
    assert 1.0 <= float(found.low) <= float(found.high) <= 3.0
    one_column = np.stack([values, np.full(4, np.nan)], axis=-1)
    found = bootstrap_mean(one_column, ["a", "a", "b", "b"], resamples=200)
    assert np.isfinite([found.low[0], found.high[0]]).all()
    assert np.isnan([found.value[1], found.low[1], found.high[1]]).all()


@pytest.mark.parametrize(
    ("values", "subjects", "options", "told"),
    [
        (np.zeros(0), [], {}, "0 subjects"),
        (np.zeros(3), ["a"], {}, "1 subjects for 3"),
        (np.zeros(1), ["a"], {"level": 1.0}, "level"),
        (np.zeros(1), ["a"], {"resamples": 0}, "resamples"),
        (np.zeros(1), ["a"], {"seed": -1}, "seed"),
    ],
)
def test_wrong_bootstrap_is_refused(
    values: np.ndarray, subjects: list[str], options: dict, told: str
) -> None:
    with pytest.raises(RequestError, match=told):
        bootstrap_mean(values, subjects, **options)
