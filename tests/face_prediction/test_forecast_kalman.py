"""The Kalman forecaster against the textbook, against statsmodels, and on noise that is known."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from face_prediction.forecast import LandmarkSequences, mouth_centre
from face_prediction.forecast.extrapolation import (
    ConstantVelocity,
    KalmanConstantVelocity,
    filter_gains,
    fit_noise,
)
from robo_manip_baselines.runs.errors import RequestError

FACE = np.random.default_rng(5).uniform(0.2, 0.8, (468, 2))


def textbook_kalman(z: np.ndarray, q: float, r: float, v: float) -> tuple[np.ndarray, float]:
    """State after series z (T,) and log-likelihood of z[1:] given z[0], by the textbook."""
    F, H = np.array([[1.0, 1], [0, 1]]), np.array([[1.0, 0]])
    Q, R = q * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]), np.array([[r]])
    x, P, log_likelihood = np.array([z[0], 0.0]), np.diag([r, v]), 0.0
    for value in z[1:]:
        x, P = F @ x, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        innovation = value - H @ x
        log_likelihood += -0.5 * (np.log(2 * np.pi * S[0, 0]) + innovation[0] ** 2 / S[0, 0])
        x, P = x + K @ innovation, (np.eye(2) - K @ H) @ P
    return x, log_likelihood


def noisy_motion(q: float, r: float, v: float, count: int, frames: int, seed: int) -> np.ndarray:
    """Measured positions (count, frames) of the filter's own model."""
    rng = np.random.default_rng(seed)
    disturbance = np.linalg.cholesky(q * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))
    state = np.stack([np.zeros(count), rng.normal(0, np.sqrt(v), count)])
    measured = []
    for _ in range(frames):
        measured.append(state[0] + rng.normal(0, np.sqrt(r), count))
        state = np.array([[1.0, 1], [0, 1]]) @ state + disturbance @ rng.normal(size=(2, count))
    return np.stack(measured, axis=1)


def test_kalman_forecasts_as_the_textbook_does() -> None:
    kalman = KalmanConstantVelocity(
        np.array([1e-6, 4e-6]), np.array([3e-6, 1e-6]), np.array([1e-5, 1e-4])
    )
    history = FACE + np.cumsum(np.random.default_rng(20).normal(0, 0.01, (12, 468, 2)), axis=0)
    forecast_frames = kalman.predict(history, 5)
    for landmark in (0, 13, 467):
        for axis in range(2):
            noise = kalman.process[axis], kalman.measurement[axis], kalman.velocity[axis]
            (position, velocity), _ = textbook_kalman(history[:, landmark, axis], *noise)
            expected = position + np.arange(1, 6) * velocity
            np.testing.assert_allclose(forecast_frames[:, landmark, axis], expected, rtol=1e-11)


def test_kalman_filters_the_mouth_as_it_filters_its_lips() -> None:
    kalman = KalmanConstantVelocity(np.full(2, 1e-6), np.full(2, 3e-6), np.full(2, 1e-5))
    history = FACE + np.random.default_rng(21).normal(0, 0.01, (12, 468, 2))
    centre = mouth_centre(history)
    rigid = np.repeat(centre[:, None], 468, axis=1)  # every landmark at the mouth
    np.testing.assert_allclose(
        mouth_centre(kalman.predict(history, 5)), kalman.predict(rigid, 5)[:, 0], rtol=1e-12
    )


def test_kalman_gains_of_short_histories() -> None:
    # the second frame: S = r + v + q / 3 + r, gain (r + v + q / 3, v + q / 2) / S
    ((gain, spread),) = filter_gains(0.3, 2.0, 5.0, 2)
    assert spread == pytest.approx(2 + 5 + 0.1 + 2)
    np.testing.assert_allclose(gain, [7.1 / 9.1, 5.15 / 9.1])
    assert not list(filter_gains(0.3, 2.0, 5.0, 1))


def test_kalman_noise_is_recovered() -> None:
    q, r, v = 1e-6, 4e-5, 1e-4
    found = fit_noise(noisy_motion(q, r, v, 600, 70, 22))
    # 42 000 frames settle r and q to a few per cent, 600 starts v to about 6 %
    np.testing.assert_allclose(found, (q, r, v), rtol=0.2)


def test_kalman_noise_is_the_most_likely() -> None:
    series = noisy_motion(1e-6, 4e-5, 1e-4, 20, 30, 23)
    found = np.array(fit_noise(series))
    best = sum(textbook_kalman(z, *found)[1] for z in series)
    for factors in ((1.1, 1, 1), (0.9, 1, 1), (1, 1.1, 1), (1, 0.9, 1), (1, 1, 1.2), (1, 1, 0.8)):
        other = sum(textbook_kalman(z, *(found * factors))[1] for z in series)
        assert other < best


def test_kalman_of_statsmodels_has_the_same_likelihood(statsmodels) -> None:
    MLEModel = statsmodels("tsa.statespace.mlemodel").MLEModel
    q, r, v = 1e-2, 4e-1, 1.0
    z = noisy_motion(q, r, v, 1, 30, 24)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = MLEModel(z[1:], k_states=2, k_posdef=2)
    model["design"] = np.array([[1.0, 0.0]])
    model["transition"] = np.array([[1.0, 1.0], [0.0, 1.0]])
    model["selection"] = np.eye(2)
    model["state_cov"] = q * np.array([[1 / 3, 1 / 2], [1 / 2, 1]])
    model["obs_cov"] = np.array([[r]])
    # its first state is that before z[1]: ours after z[0], one step on
    first = np.array([[1.0, 1], [0, 1]]) @ np.diag([r, v]) @ np.array([[1.0, 0], [1, 1]])
    model.initialize_known(np.array([z[0], 0.0]), first + model["state_cov"])
    result = model.ssm.filter()
    (position, velocity), log_likelihood = textbook_kalman(z, q, r, v)
    np.testing.assert_allclose(result.filtered_state[:, -1], [position, velocity], rtol=1e-8)
    assert result.llf == pytest.approx(log_likelihood, rel=1e-8)
    history = np.broadcast_to(z[:, None, None], (30, 468, 2))
    kalman = KalmanConstantVelocity(np.full(2, q), np.full(2, r), np.full(2, v))
    np.testing.assert_allclose(kalman.predict(history, 1)[0, 0, 0], position + velocity, rtol=1e-8)


def test_kalman_smooths_where_a_difference_would_not() -> None:
    series = noisy_motion(1e-7, 4e-5, 1e-4, 300, 75, 25)
    landmarks = np.broadcast_to(series[:, :, None, None], (300, 75, 468, 2))
    fitted = KalmanConstantVelocity.fit(
        LandmarkSequences(landmarks[:200, :40], tuple(f"s{i}" for i in range(200)))
    )
    history, truth = landmarks[200:, :70], landmarks[200:, 70:]
    ours = np.abs(fitted.predict(history, 5) - truth).mean()
    assert ours < 0.5 * np.abs(ConstantVelocity().predict(history, 5) - truth).mean()


def test_kalman_refuses_what_is_no_variance() -> None:
    good = np.ones(2)
    for bad in (np.array([1.0, 0.0]), np.array([1.0, np.nan]), np.ones(3), -good):
        with pytest.raises(RequestError, match="measurement"):
            KalmanConstantVelocity(good, bad, good)


def test_kalman_fits_still_faces() -> None:
    still = np.broadcast_to(FACE, (3, 20, 468, 2))
    fitted = KalmanConstantVelocity.fit(LandmarkSequences(still, ("a", "b", "c")))
    np.testing.assert_allclose(fitted.predict(still, 5), still[:, :5], atol=1e-15)
    with pytest.raises(RequestError, match="3 frames"):
        KalmanConstantVelocity.fit(LandmarkSequences(still[:, :3], ("a", "b", "c")))
