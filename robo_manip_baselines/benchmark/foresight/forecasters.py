"""Forecasts of the mouth for a visual servo: the truth, causal forecasters, and a control.

A causal forecaster knows the mouth in video frames of 1/30 s up to the newest one seen, without
noise. Persistence, constant velocity, autoregression and the Kalman filter are linear: a matrix of
weights for each horizon, applied to the frames seen. The last two are fitted, for each motion, to
episodes that nothing is evaluated on; of recorded motion these are other starts in the same
recordings.

Legend: H frames ahead at most, N frames seen, E episodes, T frames of an episode, D state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.expert.servo import Forecast
from robo_manip_baselines.envs.mujoco.face.motion import SEGMENT_DURATION, MotionSegment
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.observation import FRAME_PERIOD
from robo_manip_baselines.runs.autoregression import forecast, moments, solve
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.seeds import derive_seed

Floats = NDArray[np.float64]
Path3D = Callable[[ArrayLike], Floats]
"""The mouth, (..., 3) m, at times (...) s."""

MAX_LEAD = 24
"""H, frames ahead that a forecast is asked for at most."""

FIT_EPISODES = 48
"""E, of which the first three quarters are fitted to and the others choose what is fitted."""

FIT_HORIZON = 8
"""Frames ahead at which the error of forecasts is least for the settings that are chosen."""

ORDERS = (2, 4, 8, 16)
"""Orders of autoregression to choose from."""

KALMAN_MEMORY = 45
"""Frames that a Kalman filter looks back; its gains are those of an endless past."""

NOISE_RATIOS = tuple(10.0 ** np.arange(-5.0, 5.0))
"""Process noise by measurement noise, in frames, to choose from."""


@dataclass(frozen=True, eq=False)
class LinearForecaster:
    """Forecast that is linear in the frames seen.

    Attributes:
        weights: (H + 1, N, 3, 3): the mouth h frames ahead is the sum over k of
            ``weights[h, k] @ mouth[k]``, the newest frame being k = 0.
    """

    weights: Floats

    def __call__(self, mouth: Path3D, seen: float, ahead: float) -> Floats:
        """Return the mouth (3,) m, ``ahead`` s after the newest frame, seen at ``seen`` s.

        Between two horizons it is interpolated.

        Raises:
            ValueError: it is further ahead than H frames.
        """
        frames = mouth(seen - FRAME_PERIOD * np.arange(self.weights.shape[1]))
        return np.einsum("nij,nj->i", self._weights_at(ahead / FRAME_PERIOD), frames)

    def ahead_of(self, paths: Floats, horizon: int) -> Floats:
        """Return forecasts (E, T - N + 1, 3) m, ``horizon`` frames ahead of paths (E, T, 3) m.

        The first one is that of the first frame with N - 1 others before it.
        """
        count = self.weights.shape[1]
        seen = np.lib.stride_tricks.sliding_window_view(paths, count, axis=1)[..., ::-1]
        return np.einsum("nij,etjn->eti", self.weights[horizon], seen, optimize=True)

    def error(self, paths: Floats, horizon: int) -> float:
        """Return the root mean square, m, of the error of `ahead_of`."""
        first = self.weights.shape[1] - 1 + horizon
        error = self.ahead_of(paths, horizon)[:, : paths.shape[1] - first] - paths[:, first:]
        return math.sqrt(float((error**2).sum(axis=-1).mean()))

    def _weights_at(self, frames: float) -> Floats:
        last = len(self.weights) - 1
        # A millionth of a frame for times that are meant to be those of frames.
        if not -1e-6 <= frames <= last + 1e-6:
            raise ValueError(f"{frames} frames ahead: must be 0 to {last}")
        low = min(max(math.floor(frames + 1e-6), 0), last)
        share = frames - low
        if abs(share) < 1e-5:
            return self.weights[low]
        return (1.0 - share) * self.weights[low] + share * self.weights[low + 1]


def _each_axis(weights: Floats) -> LinearForecaster:
    """Return the forecaster that applies weights (H + 1, N) to each axis by itself."""
    return LinearForecaster(weights[:, :, None, None] * np.eye(3))


def persistence() -> LinearForecaster:
    """Make the forecast that the mouth stays where it was seen."""
    return _each_axis(np.ones((MAX_LEAD + 1, 1)))


def constant_velocity() -> LinearForecaster:
    """Make the forecast that the mouth goes on as from the last frame to the newest."""
    ahead = np.arange(MAX_LEAD + 1.0)
    return _each_axis(np.stack([1.0 + ahead, -ahead], axis=1))


def autoregression(coefficients: Floats) -> LinearForecaster:
    """Make a vector autoregression on displacements, see `runs.autoregression`.

    Args:
        coefficients: (P, 3, 3).
    """
    order = len(coefficients)
    # The response to a displacement of 1 m, k frames ago, along each axis.
    unit = np.eye(3 * order).reshape(order, 3, order, 3)[:, :, ::-1]
    moved = forecast(coefficients, unit.reshape(3 * order, order, 3), MAX_LEAD).cumsum(axis=1)
    response = np.zeros((MAX_LEAD + 1, order + 1, 3, 3))
    response[1:, :order] = moved.reshape(order, 3, MAX_LEAD, 3).transpose(2, 0, 3, 1)
    weights = response.copy()  # a displacement is the difference of two frames
    weights[:, 1:] -= response[:, :-1]
    weights[:, 0] += np.eye(3)
    return LinearForecaster(weights)


def kalman(size: int, noise_ratio: float) -> LinearForecaster:
    """Make a Kalman filter in its steady state, for each axis by itself.

    The state of an axis is position and velocity, or these and the acceleration; the derivative of
    the last one is white noise of density q, and frames have noise of variance r (Bar-Shalom, Li
    and Kirubarajan 2001, sections 6.2.2 and 6.2.3). The forecast is the state without noise.

    Args:
        size: D, 2 for constant velocity, 3 for constant acceleration.
        noise_ratio: q / r, time counted in frames.
    """
    from scipy.linalg import solve_discrete_are  # slow to import

    powers = np.subtract.outer(-np.arange(size), -np.arange(size))  # j - i
    factorial = np.array([math.factorial(n) for n in range(size)], dtype=np.float64)
    step = np.where(powers >= 0, 1.0 / factorial[np.abs(powers)], 0.0)
    # Integral over a frame of what noise in the highest derivative adds: t^(D-1-i) / (D-1-i)!
    up = size - 1 - np.arange(size)
    sums = np.add.outer(up, up) + 1.0
    noise = noise_ratio / (sums * np.multiply.outer(factorial[up], factorial[up]))
    seen = np.eye(1, size)
    covariance = solve_discrete_are(step.T, seen.T, noise, np.eye(1))
    gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
    # The filter is run on each frame's part alone: column k for the frame that is k old.
    state = np.zeros((size, KALMAN_MEMORY))
    state[0, -1] = 1.0
    for age in range(KALMAN_MEMORY - 2, -1, -1):
        state = step @ state
        innovation = -state[0]
        innovation[age] += 1.0
        state += gain[:, None] * innovation
    ahead = np.arange(MAX_LEAD + 1.0)[:, None] ** np.arange(size) / factorial
    return _each_axis(ahead @ state)


def fit_autoregression(paths: Floats) -> LinearForecaster:
    """Fit an autoregression to paths (E, T, 3) m, of the order with the least error."""
    fitted, held_out = _split(paths)
    sums = moments(np.diff(fitted, axis=1), max(ORDERS))
    # Rounded, so that the number of threads of BLAS, which sums in another order, changes nothing.
    made = [autoregression(solve(sums, order, 3).round(6)) for order in ORDERS]
    return min(made, key=lambda forecaster: forecaster.error(held_out, FIT_HORIZON))


def fit_kalman(paths: Floats) -> LinearForecaster:
    """Choose the Kalman filter with the least error on paths (E, T, 3) m."""
    _, held_out = _split(paths)
    made = [kalman(size, ratio) for size in (2, 3) for ratio in NOISE_RATIOS]
    return min(made, key=lambda forecaster: forecaster.error(held_out, FIT_HORIZON))


def _split(paths: Floats) -> tuple[Floats, Floats]:
    count = 3 * len(paths) // 4
    return paths[:count], paths[count:]


class Forecasters:
    """Forecasters of the motion of one environment, by name.

    Args:
        world: the environment, unwrapped.
    """

    def __init__(self, world: FaceEnv) -> None:
        self._world = world

    def start(self, name: str, seed: int) -> Forecast:
        """Return the forecast of a name in the present episode.

        Args:
            name: one of ``FORECASTERS``.
            seed: of the episode.

        Raises:
            RequestError: the motion has no such forecast.
        """
        world = self._world
        if name == "truth":
            return lambda seen, ahead: world.mouth_at(seen + ahead)
        if name == "shuffled":
            return self._shuffled(seed)
        if name == "residual":
            return self._residual()
        forecaster = self._linear[name]
        return lambda seen, ahead: forecaster(world.mouth_at, seen, ahead)

    @cached_property
    def paths(self) -> Floats:
        """(E, T, 3) m, displacement of the mouth in episodes that nothing is evaluated on."""
        time = np.arange(round(SEGMENT_DURATION / FRAME_PERIOD)) * FRAME_PERIOD
        drawn = [self._draw(derive_seed(0, "fit", n)) for n in range(FIT_EPISODES)]
        return np.stack([segment.displacement_at(time) for segment in drawn])

    @cached_property
    def _linear(self) -> dict[str, LinearForecaster]:
        return {
            "persistence": persistence(),
            "constant_velocity": constant_velocity(),
            "autoregression": fit_autoregression(self.paths),
            "kalman": fit_kalman(self.paths),
        }

    def _shuffled(self, seed: int) -> Forecast:
        """Return the forecast that the mouth moves as in another episode at this time."""
        world, other = self._world, self._draw(derive_seed(seed, "shuffled"))

        def shuffled(seen: float, ahead: float) -> Floats:
            now, then = other.displacement_at(np.maximum([seen, seen + ahead], 0.0))
            return world.mouth_at(seen) + then - now

        return shuffled

    def _residual(self) -> Forecast:
        """Return a trained predictor's forecast, its error held from frame to frame.

        Further ahead than the predictor looks, it is held.
        """
        world, horizon = self._world, residual_horizon(self._world)
        if not horizon:
            raise RequestError(
                f"forecaster residual: motion '{world.motion}' of library "
                f"'{world.library.source}' has no predictions; leave it out"
            )

        def residual(seen: float, ahead: float) -> Floats:
            found = world.segment.prediction_error(max(seen, 0.0))
            assert found is not None
            errors = np.concatenate([np.zeros((1, 3)), found])
            frames = min(ahead / FRAME_PERIOD, float(horizon))
            error = [np.interp(frames, np.arange(horizon + 1), axis) for axis in errors.T]
            return world.mouth_at(seen + frames * FRAME_PERIOD) + np.array(error)

        return residual

    def _draw(self, seed: int) -> MotionSegment:
        world = self._world
        rng = np.random.default_rng(seed)
        return world.motion.draw(rng, world.library, seed=seed, clips=world.clips)


def residual_horizon(world: FaceEnv) -> int:
    """Return how many frames a trained predictor looks ahead in an environment; 0 without one."""
    predicted = world.library.predicted
    return predicted.shape[1] if predicted is not None and world.motion.is_as_recorded else 0


FORECASTERS = (
    *("truth", "persistence", "constant_velocity", "autoregression", "kalman", "residual"),
    "shuffled",
)
"""Names of the forecasters."""
