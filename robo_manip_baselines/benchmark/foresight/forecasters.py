"""Forecasts of the mouth for a visual servo: the truth, causal forecasters, a trained predictor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.expert.servo import Forecast
from robo_manip_baselines.envs.mujoco.face.forecasters import MotionForecasters
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.observation import FRAME_PERIOD, MAX_HORIZON
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

FORECASTERS = (
    *("truth", "persistence", "constant_velocity", "autoregression", "kalman", "residual"),
    "shuffled",
)
"""Names of the forecasters."""


class Forecasters:
    """Forecasters of the motion of one environment, by name.

    Args:
        world: the environment, unwrapped.
    """

    def __init__(self, world: FaceEnv) -> None:
        self._world = world
        self._made = MotionForecasters.of(world.motion, world.library, world.people)

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
            return self._residual() if world.motion.is_as_recorded else self._followed(seed)
        forecaster = self._made.linear(name)
        return lambda seen, ahead: forecaster(world.mouth_at, seen, ahead)

    def _shuffled(self, seed: int) -> Forecast:
        """Return the forecast that the mouth moves as in another episode at this time."""
        world, other = self._world, self._made.another_episode(seed)

        def shuffled(seen: float, ahead: float) -> Floats:
            now, then = other.displacement_at(np.maximum([seen, seen + ahead], 0.0))
            return world.mouth_at(seen) + then - now

        return shuffled

    def _followed(self, seed: int) -> Forecast:
        """Return a predictor's that follows the mouth, made at the last control step until then."""
        track = self._world.replay.mouth
        made = self._made.forecast_track("residual", track, seed)

        def followed(seen: float, ahead: float) -> Floats:
            step = min(int(max(seen, 0.0) / CONTROL_PERIOD + 1e-6), len(track) - 1)
            known = np.concatenate([track[step, :1], made[step]])
            frames = (seen + ahead - step * CONTROL_PERIOD) / FRAME_PERIOD
            return np.array([np.interp(frames, np.arange(len(known)), axis) for axis in known.T])

        return followed

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


def residual_horizon(world: FaceEnv) -> int:
    """Return how many frames a trained predictor looks ahead in an environment; 0 without one.

    Of recorded motion it is the library's, of any other one it is fitted to the motion.
    """
    if not world.motion.is_as_recorded:
        return MAX_HORIZON
    predicted = world.library.predicted
    return 0 if predicted is None else predicted.shape[1]
