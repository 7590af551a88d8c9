"""Residual prediction of a mouth whose place is known in metres, without landmarks or images.

Across the view the mouth is followed as in an image; its depth is followed as a second mouth, which
moves along one axis only. Both have the coefficients of the same people, and each learns from what
it does itself. Nothing need jitter here as landmarks do, so that experts see more of the past.

Shapes: E people, N mouths, T frames of 1/30 s, W recent frames, H horizon, K knots. The first axis
of a path is the depth, the other two lie across the view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from face_prediction.models.residual.adaptive import FaceState, PeopleFit
from face_prediction.models.residual.experts import SHAPES, Floats, LinearExpert
from face_prediction.models.residual.fit import fit_people, trial, usual_errors
from face_prediction.models.residual.intervals import IntervalFit
from face_prediction.models.residual.predictor import HORIZON, ResidualFit, require_horizon
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

EXPERTS = (
    LinearExpert(0, 1, 0, iterated=True),
    LinearExpert(0, 8, 2, differences=True),
    LinearExpert(0, 4, 2, differences=True),
)
"""Chosen, as `RIDGE` is, by the errors on people that fits to dyskinetic, sway and recorded motion
hold out."""

RIDGE = 1e-8
"""Less than a face's: it has only to keep the fit from failing where a motion is exactly linear."""

FACE_SIDE = 0.21
"""m, side of a crop around a face: the median of the shipped motion library."""

LEAST_PEOPLE = 4
"""Of whom three quarters are fitted to, and the errors measured on the others."""


@dataclass(frozen=True)
class PathPredictor:
    """Residual prediction fitted to the paths of people; see `fit_paths`.

    Attributes:
        people: experts' coefficients and errors.
        between: (24, K) forecasts in every frame ahead of those at knots, cubic splines between
            them that begin at the newest frame: a mouth that moves fast turns within them.
    """

    people: PeopleFit
    between: Floats

    @property
    def recent(self) -> int:
        """W, frames that a forecast is made from, beside what was learnt."""
        return self.people.recent

    def follow(self, mouths: int = 1) -> FollowedPaths:
        """Return the state of N mouths that are seen for the first time."""
        return FollowedPaths(self, mouths)


class FollowedPaths:
    """State of mouths that are followed from frame to frame, each by itself.

    Until they were seen in W frames they are forecast to stay: nobody knows how they moved before.

    Args:
        predictor: fitted to the training people.
        mouths: N.
    """

    def __init__(self, predictor: PathPredictor, mouths: int) -> None:
        self._predictor, self._state = predictor, FaceState(predictor.people, 2 * mouths)

    def update(self, mouths: NDArray[np.floating]) -> None:
        """Take in the mouths (N, 3) m in the next frame, 1/30 s after the one before."""
        self._state.take(path_series(mouths[:, None])[:, 0])
        self._state.remember(self._state.forecast())

    def forecast(self, recent: NDArray[np.floating], horizon: int) -> Floats:
        """Return the mouths (N, H, 3) m in the frames after ``recent`` (N, W, 3), the newest last.

        These are 1/30 s apart, and need not be frames that were taken in.

        Raises:
            RequestError: the horizon is longer than 24.
        """
        require_horizon(horizon)
        if self._state.mixture.frames < self._predictor.recent:
            return np.repeat(recent[:, -1:], horizon, axis=1)
        knots = self._state.forecast(path_series(recent)).moved
        # Summed by NumPy itself in a fixed order: BLAS rounds otherwise for another horizon.
        ahead = np.einsum("hk,nkd->nhd", self._predictor.between[:horizon], knots)
        across, depth = FACE_SIDE * ahead[::2], FACE_SIDE * ahead[1::2]
        return recent[:, -1:] + np.concatenate([depth[..., :1], across], axis=-1)


def fit_paths(paths: NDArray[np.floating]) -> PathPredictor:
    """Fit residual prediction to paths (E, T, 3) m, each of another person.

    BLAS has one thread for as long as this takes: with more it sums in another order.

    Raises:
        RequestError: they are fewer than four.
    """
    from scipy.interpolate import CubicSpline  # slow to import

    if len(paths) < LEAST_PEOPLE:
        raise RequestError(f"paths of {len(paths)} people; residual needs {LEAST_PEOPLE} or more")
    with threadpool_limits(1, user_api="blas"):
        people = _fit(paths)
    knots = np.concatenate([[0], people.horizons])
    spline = CubicSpline(knots, np.eye(len(knots)))
    return PathPredictor(people, spline(np.arange(1, HORIZON + 1))[:, 1:])


def _fit(paths: NDArray[np.floating]) -> PeopleFit:
    count = 3 * len(paths) // 4
    fitted, held_out = (list(path_series(part)) for part in (paths[:count], paths[count:]))
    people = fit_people(fitted, [str(number // 2) for number in range(len(fitted))], EXPERTS, RIDGE)
    people = replace(people, unlearnt=people.recent - 1)
    no_shapes = np.zeros((SHAPES, 2 * NUM_LANDMARKS))
    tried = trial(ResidualFit(no_shapes, people, IntervalFit.unknown()), held_out)
    made, mixed = ([pair[part] for pair in tried] for part in range(2))
    return replace(people, usual=usual_errors(made, mixed, held_out, people.pace))


def path_series(paths: NDArray[np.floating]) -> Floats:
    """Series (2 N, T, 2) in face sides of paths (N, T, 3) m: of each across the view, and depth."""
    series = np.zeros((2 * len(paths), paths.shape[1], 2))
    series[::2], series[1::2, :, 0] = paths[..., 1:], paths[..., 0]
    return series / FACE_SIDE
