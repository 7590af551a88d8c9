"""Forecasts that extrapolate each landmark by itself: still, at constant velocity, filtered.

Legend: N sequences, B batch, T frames, H horizon, L landmarks; axes are u and v of the crop.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import Array, Forecaster, LandmarkSequences, mouth_centre
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self

_TRANSITION = np.array([[1.0, 1.0], [0.0, 1.0]])
_DISTURBANCE = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
# Crops squared: below what float32 coordinates resolve; keeps the fit to a still face finite.
_SMALLEST_VARIANCE = 1e-14
# log10 of q / r and v / r: from a mouth at rest to a detector without noise
_BOUNDS = ((-8.0, 6.0), (-6.0, 10.0))


class _Unfitted(Forecaster):
    """A forecaster without parameters to fit."""

    @classmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Nothing is fitted."""
        return cls()


@dataclass(frozen=True)
class Persistence(_Unfitted):
    """Every future frame is the last one seen."""

    name = "persistence"

    @property
    def memory(self) -> int:
        """The last frame."""
        return 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        return np.repeat(history[:, -1:].astype(np.float64), horizon, axis=1)


@dataclass(frozen=True)
class ConstantVelocity(_Unfitted):
    """Each landmark keeps its mean velocity over the last ``window`` frames.

    velocity = (last frame - frame ``window`` before it) / window, in crops a frame; with fewer
    frames the whole history is the window, and one frame has velocity 0.

    Attributes:
        window: frames of the velocity; 1 is the last step alone.
    """

    window: int = 1

    name = "constant_velocity"

    def __post_init__(self) -> None:
        if self.window < 1:
            raise RequestError(f"constant_velocity: window {self.window}; must be 1 or more frames")

    @property
    def memory(self) -> int:
        """The window and the last frame."""
        return self.window + 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        last = history[:, -1].astype(np.float64)
        velocity = (last - history[:, 0]) / max(history.shape[1] - 1, 1)
        return last[:, None] + _ahead(horizon) * velocity[:, None]


@dataclass(frozen=True)
class LineFit(_Unfitted):
    """The least-squares line through each landmark's last ``frames`` frames, prolonged.

    It smooths position and velocity; one frame has velocity 0.
    """

    frames: int = 5

    name = "line"

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise RequestError(f"line: {self.frames} frames; must be 2 or more")

    @property
    def memory(self) -> int:
        """The frames of the line."""
        return self.frames

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        frames = history.shape[1]
        time = np.arange(frames) - (frames - 1) / 2  # about the middle of the line
        spread = float(time @ time) or 1.0  # one frame: no spread, and no velocity
        velocity = np.einsum("t,btlc->blc", time / spread, history)
        middle = history.mean(axis=1, dtype=np.float64)
        return middle[:, None] + ((frames - 1) / 2 + _ahead(horizon)) * velocity[:, None]


def _ahead(horizon: int) -> NDArray[np.float64]:
    """Frames ahead, 1 to H, as (1, H, 1, 1)."""
    return np.arange(1.0, horizon + 1)[None, :, None, None]


@dataclass(frozen=True)
class KalmanConstantVelocity(Forecaster):
    """Constant velocity, the velocity and the position estimated by a Kalman filter.

    Each coordinate of each landmark has the state (position, velocity). From one frame to the next

        position += velocity,    covariance of the disturbance  q [[1/3, 1/2], [1/2, 1]]

    (white acceleration of density q, Bar-Shalom, Li, Kirubarajan 2001, 6.2.2), and the detector
    adds white noise of variance r. Before the first frame nothing is known of the position; the
    velocity is 0 with variance v. All three are fitted to the mouth centre by maximum likelihood,
    an axis each, and serve every landmark: the gains of the filter then are the same for all, so
    the filtered mouth centre is the mean of the filtered lips.

    Attributes:
        process: (2,) q of u and v, crops^2 / frame^3.
        measurement: (2,) r of u and v, crops^2.
        velocity: (2,) variance of the velocity before the first frame, (crops / frame)^2.
    """

    process: NDArray[np.float64]
    measurement: NDArray[np.float64]
    velocity: NDArray[np.float64]

    name = "kalman"

    def __post_init__(self) -> None:
        for field in ("process", "measurement", "velocity"):
            value = np.asarray(getattr(self, field), dtype=float)
            if value.shape != (2,) or not np.all(np.isfinite(value) & (value > 0)):
                raise RequestError(f"kalman: {field} {value}; expected two positive numbers")

    @classmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Fit q, r and v of each axis to the mouth centres by maximum likelihood.

        Raises:
            RequestError: the sequences have fewer than 4 frames.
        """
        mouth = mouth_centre(sequences.landmarks)
        if (frames := mouth.shape[1]) < 4:
            raise RequestError(
                f"kalman: sequences of {frames} frames; 4 or more needed to fit noise"
            )
        q, r, v = np.array([fit_noise(mouth[..., axis]) for axis in range(2)]).T
        return cls(q, r, v)

    @property
    def memory(self) -> None:
        """All frames count, the older the less."""
        return

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        frames = history.shape[1]
        gains = np.stack(
            [
                [gain for gain, _ in filter_gains(q, r, v, frames)]
                for q, r, v in zip(self.process, self.measurement, self.velocity, strict=True)
            ],
            axis=-1,
        )  # (T - 1, 2 of the state, 2 axes)
        position = history[:, 0].astype(np.float64)
        velocity = np.zeros_like(position)
        for frame, (gain_position, gain_velocity) in enumerate(gains, start=1):
            position += velocity
            innovation = history[:, frame] - position
            position += gain_position * innovation
            velocity += gain_velocity * innovation
        return position[:, None] + _ahead(horizon) * velocity[:, None]


def filter_gains(
    process: float, measurement: float, velocity: float, frames: int
) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Gain (2,) and variance of the innovation at frames 1 to ``frames`` - 1.

    Frame 0 starts the filter: of the position only its measurement is known.
    """
    covariance = np.diag([measurement, velocity])
    for _ in range(1, frames):
        covariance = _TRANSITION @ covariance @ _TRANSITION.T + process * _DISTURBANCE
        spread = covariance[0, 0] + measurement
        gain = covariance[:, 0] / spread
        covariance = covariance - spread * np.outer(gain, gain)
        yield gain, spread


def fit_noise(series: NDArray[np.float64]) -> tuple[float, float, float]:
    """(q, r, v) of maximum likelihood for one coordinate in N sequences (N, T)."""
    if np.all(series[:, :1] == series):
        return _SMALLEST_VARIANCE, _SMALLEST_VARIANCE, _SMALLEST_VARIANCE

    def cost(log_ratios: NDArray[np.float64]) -> float:
        return _profile(series, *(10.0**log_ratios))[0]

    from scipy.optimize import minimize  # half a second to import

    # where the mouth moves smoothly and the detector trembles, or the other way round
    starts = ([-2.0, 0.0], [0.0, 1.0])
    how = {"method": "Nelder-Mead", "bounds": _BOUNDS, "options": {"xatol": 1e-3}}
    best = min((minimize(cost, start, **how) for start in starts), key=lambda fit: fit.fun)
    q_ratio, v_ratio = 10.0**best.x
    r = max(_profile(series, q_ratio, v_ratio)[1], _SMALLEST_VARIANCE)
    return q_ratio * r, r, v_ratio * r


def _profile(series: NDArray[np.float64], q_ratio: float, v_ratio: float) -> tuple[float, float]:
    """Minus the log-likelihood a frame at the best r for q / r and v / r, and that r."""
    position = series[:, 0].copy()
    velocity = np.zeros_like(position)
    squares = logs = 0.0
    for frame, (gain, spread) in enumerate(
        filter_gains(q_ratio, 1.0, v_ratio, series.shape[1]), start=1
    ):
        position += velocity
        innovation = series[:, frame] - position
        squares += float(innovation @ innovation) / spread
        logs += np.log(spread)
        position += gain[0] * innovation
        velocity += gain[1] * innovation
    steps = series.shape[1] - 1
    r = squares / (len(series) * steps)
    return 0.5 * (np.log(2 * np.pi * r) + 1.0 + logs / steps), r
