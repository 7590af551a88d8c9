"""Forecasters against closed forms, and what they may know."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from robo_manip_baselines.benchmark.foresight.forecasters import (
    FORECASTERS,
    Forecasters,
    residual_horizon,
)
from robo_manip_baselines.envs.mujoco.face.forecasters import (
    KALMAN_MEMORY,
    MAX_LEAD,
    LinearForecaster,
    MotionForecasters,
    autoregression,
    constant_velocity,
    fit_autoregression,
    fit_kalman,
    kalman,
    persistence,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.observation import FRAME_PERIOD
from robo_manip_baselines.runs.autoregression import forecast
from robo_manip_baselines.runs.errors import RequestError

START, VELOCITY = np.array([0.0, 0.5, 0.35]), np.array([0.01, -0.04, 0.02])
HORIZONS = [0.0, 1.0, 2.5, 8.0, MAX_LEAD]


def line(time: ArrayLike) -> np.ndarray:
    return START + np.multiply.outer(np.asarray(time), VELOCITY)


def waves(episodes: int, frames: int = 360, seed: int = 0) -> np.ndarray:
    """(E, T, 3) m: a sinusoid of 0.5 Hz and 20 mm on each axis, of other phases."""
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (episodes, 1, 3))
    time = np.arange(frames)[None, :, None] * FRAME_PERIOD
    return 0.02 * np.sin(np.pi * time + phase)


@pytest.mark.parametrize("frames", HORIZONS)
@pytest.mark.parametrize(
    "forecaster",
    [constant_velocity(), kalman(2, 0.1), kalman(3, 1.0)],
    ids=["constant_velocity", "kalman_2", "kalman_3"],
)
def test_a_constant_velocity_is_forecast_exactly(
    forecaster: LinearForecaster, frames: float
) -> None:
    found = forecaster(line, 2.0, frames * FRAME_PERIOD)
    np.testing.assert_allclose(found, line(2.0 + frames * FRAME_PERIOD), atol=1e-9)


@pytest.mark.parametrize("frames", HORIZONS)
def test_persistence_is_the_newest_frame(frames: float) -> None:
    np.testing.assert_allclose(persistence()(line, 2.0, frames * FRAME_PERIOD), line(2.0))


@pytest.mark.parametrize("frames", [-1.0, MAX_LEAD + 0.1])
def test_a_forecast_out_of_range_is_an_error(frames: float) -> None:
    with pytest.raises(ValueError, match=f"must be 0 to {MAX_LEAD}"):
        constant_velocity()(line, 2.0, frames * FRAME_PERIOD)


def test_autoregression_is_that_of_displacements() -> None:
    rng = np.random.default_rng(3)
    coefficients, path = 0.2 * rng.normal(size=(4, 3, 3)), rng.normal(size=(30, 3))
    steps = np.diff(path, axis=0)
    expected = path[-1] + np.cumsum(forecast(coefficients, steps[None], MAX_LEAD)[0], axis=0)
    found = autoregression(coefficients)
    for frames in (1, 5, MAX_LEAD):
        ahead = found.ahead_of(path[None], frames)[0, -1]
        np.testing.assert_allclose(ahead, expected[frames - 1], atol=1e-9)


def test_autoregression_learns_a_sinusoid() -> None:
    """Its error at 8 frames, half a period ahead at 1.9 Hz, is a few per cent of the amplitude."""
    held_out = waves(4, seed=1)
    fitted = fit_autoregression(waves(16))
    assert fitted.error(held_out, 8) < 0.05 * 0.02
    assert constant_velocity().error(held_out, 8) > 5.0 * fitted.error(held_out, 8)


def stepwise_kalman(path: np.ndarray, size: int, ratio: float, horizon: int) -> float:
    """Run the textbook's filter over a path (T,), and forecast with its last state."""
    if size == 2:
        step = np.array([[1.0, 1.0], [0.0, 1.0]])
        noise = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    else:
        step = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
        noise = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
    state, covariance = np.zeros(size), np.eye(size) * 1e3
    for seen in path:
        state, covariance = step @ state, step @ covariance @ step.T + ratio * noise
        gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
        state = state + gain * (seen - state[0])
        covariance = covariance - np.outer(gain, covariance[0])
    return float((np.linalg.matrix_power(step, horizon) @ state)[0])


@pytest.mark.parametrize(("size", "ratio"), [(2, 0.1), (2, 10.0), (3, 0.1), (3, 10.0)])
def test_the_kalman_filter_converges_to_the_textbooks(size: int, ratio: float) -> None:
    path = np.cumsum(np.random.default_rng(0).normal(size=300))
    found = kalman(size, ratio)
    for horizon in (0, 1, 8):
        ahead = found.ahead_of(np.repeat(path[None, :, None], 3, axis=2), horizon)[0, -1]
        # The first frame of its memory is forgotten to a thousandth of the spread.
        expected = stepwise_kalman(path, size, ratio, horizon)
        np.testing.assert_allclose(ahead, expected, atol=1e-3 * path.std())
    assert found.weights.shape == (MAX_LEAD + 1, KALMAN_MEMORY, 3, 3)


def test_a_kalman_filter_without_noise_keeps_the_newest_frame() -> None:
    """Of the innovation, 3 - sqrt(3) goes into the velocity: the Riccati equation at r = 0."""
    now, ahead = kalman(2, 1e9).weights[:2, 0, 0, 0]
    assert now == pytest.approx(1.0)
    assert ahead - now == pytest.approx(3.0 - math.sqrt(3.0))


def test_the_chosen_kalman_filter_is_better_than_constant_velocity_on_noise() -> None:
    noisy = waves(16) + 0.002 * np.random.default_rng(2).normal(size=(16, 360, 3))
    assert fit_kalman(noisy).error(noisy, 8) < 0.5 * constant_velocity().error(noisy, 8)


def test_errors_are_those_of_each_frame() -> None:
    path = np.zeros((1, 6, 3))
    path[0, 4:, 0] = 3.0  # one frame ahead, 1 of 5 forecasts is wrong by 3
    assert persistence().error(path, 1) == pytest.approx(math.sqrt(9.0 / 5.0))


CAUSAL = [name for name in FORECASTERS if name not in ("truth", "residual")]


@pytest.mark.parametrize("name", CAUSAL)
def test_another_future_changes_no_forecast(
    name: str, dyskinetic: FeedingEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    dyskinetic.reset(seed=2)
    made, true = Forecasters(dyskinetic).start(name, 2), dyskinetic.mouth_at
    before = made(3.0, 8 * FRAME_PERIOD)

    def other(time):
        assert np.max(time) <= 3.0 + 1e-9
        return true(time)

    monkeypatch.setattr(dyskinetic, "mouth_at", other)
    np.testing.assert_array_equal(made(3.0, 8 * FRAME_PERIOD), before)
    assert not np.allclose(before, true(3.0 + 8 * FRAME_PERIOD), atol=1e-9)


def test_the_truth_is_the_future(dyskinetic: FeedingEnv) -> None:
    dyskinetic.reset(seed=2)
    found = Forecasters(dyskinetic).start("truth", 2)(3.0, 0.2)
    np.testing.assert_array_equal(found, dyskinetic.mouth_at(3.2))


def test_shuffled_has_the_motion_of_another_episode(dyskinetic: FeedingEnv) -> None:
    """As fast as the truth, and as far from it as two episodes are from one another."""
    dyskinetic.reset(seed=2)
    made, time = Forecasters(dyskinetic).start("shuffled", 2), np.arange(1.0, 10.0, 0.1)
    np.testing.assert_array_equal(made(3.0, 0.0), dyskinetic.mouth_at(3.0))
    ahead = np.stack([made(t, 0.2) - dyskinetic.mouth_at(t) for t in time])
    true = dyskinetic.mouth_at(time + 0.2) - dyskinetic.mouth_at(time)
    assert 0.5 < ahead.std() / true.std() < 2.0
    assert abs(np.corrcoef(ahead.ravel(), true.ravel())[0, 1]) < 0.4


def test_residual_is_the_predictors_output(
    recorded: FeedingEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded.reset(seed=4)
    horizon = residual_horizon(recorded)
    assert horizon >= 5
    segment = recorded.segment
    assert segment.predicted is not None
    frame, made = 90, Forecasters(recorded).start("residual", 4)
    seen = frame * FRAME_PERIOD
    start = recorded.mouth_at(0.0) - segment.displacement_at(0.0)
    for ahead in (1, horizon):
        expected = start + segment.predicted[frame, ahead - 1]
        np.testing.assert_allclose(made(seen, ahead * FRAME_PERIOD), expected, atol=1e-9)
    np.testing.assert_allclose(made(seen, (horizon + 3) * FRAME_PERIOD), expected, atol=1e-9)
    # Another future changes nothing.
    moved = segment.displacement.copy()
    moved[frame + 1 :] += 0.01
    monkeypatch.setattr(recorded, "segment", replace(segment, displacement=moved))
    np.testing.assert_allclose(made(seen, horizon * FRAME_PERIOD), expected, atol=1e-9)


def test_recordings_without_predictions_have_no_residual(
    recorded: FeedingEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded, "library", replace(recorded.library, predicted=None))
    assert residual_horizon(recorded) == 0
    with pytest.raises(RequestError, match=r"motion 'recorded' .* has no predictions"):
        Forecasters(recorded).start("residual", 0)


def test_residual_of_a_computed_motion_follows_the_mouth(dyskinetic: FeedingEnv) -> None:
    dyskinetic.reset(seed=2)
    assert residual_horizon(dyskinetic) == 24
    made = Forecasters(dyskinetic).start("residual", 2)
    fitted = MotionForecasters.of(dyskinetic.motion, dyskinetic.library, dyskinetic.people)
    track = fitted.forecast_track("residual", dyskinetic.replay.mouth, 2)
    for step in (0, 100, 153):
        seen = step * 0.02
        np.testing.assert_allclose(made(seen, 0.0), dyskinetic.mouth_at(seen), atol=1e-9)
        for ahead in (1, 8, 24):
            wanted = track[step, ahead - 1]
            np.testing.assert_allclose(made(seen, ahead * FRAME_PERIOD), wanted, atol=1e-9)
        # Later, and before the next control step, it is the same forecast.
        later = (track[step, 3] + 2 * track[step, 4]) / 3
        moment = seen + 0.01
        np.testing.assert_allclose(
            made(moment, (4 + 2 / 3) * FRAME_PERIOD - 0.01), later, atol=1e-9
        )


def test_weights_are_interpolated_between_horizons() -> None:
    weights = np.zeros((3, 1, 3, 3))
    weights[1, 0], weights[2, 0] = np.eye(3), 3.0 * np.eye(3)
    found = LinearForecaster(weights)(lambda time: np.ones((1, 3)), 0.0, 1.25 * FRAME_PERIOD)
    np.testing.assert_allclose(found, 1.5)
