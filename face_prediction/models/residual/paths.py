"""Residual prediction of a mouth whose place is known in metres, without landmarks or images.

The mouth is that of a face that moves as one piece. Across the view it is followed as in an image;
its depth is followed as a second face, which moves along one axis only. Both have the coefficients
of the same people, and each learns from what it does itself.

Shapes: E people, T frames of 1/30 s, W recent frames, H horizon, D series. The first axis of a path
is the depth, the other two lie across the view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from face_prediction.models.residual.adaptive import FaceState, PeopleFit
from face_prediction.models.residual.experts import EXPERTS as FACE_EXPERTS
from face_prediction.models.residual.experts import RECENT, SHAPES, Floats
from face_prediction.models.residual.fit import fit_people, trial, usual_errors
from face_prediction.models.residual.intervals import IntervalFit
from face_prediction.models.residual.predictor import ResidualFit, every_frame, require_horizon
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

EXPERTS = tuple(replace(expert, shapes=min(expert.shapes, 2)) for expert in FACE_EXPERTS)
"""A face that moves as one piece has two principal shapes, its translations across the view."""

FACE_SIDE = 0.21
"""m, side of a crop around a face: the median of the shipped motion library."""

LEAST_PEOPLE = 4
"""Of whom three quarters are fitted to, and the errors measured on the others."""

_DIGITS = 6


@dataclass(frozen=True)
class PathPredictor:
    """Residual prediction fitted to the paths of people; see `fit_paths`.

    Attributes:
        people: experts' coefficients and errors.
        recent: W, frames that a forecast is made from, beside what was learnt.
    """

    people: PeopleFit
    recent: int = RECENT

    def follow(self) -> FollowedPath:
        """Return the state of a mouth that is seen for the first time."""
        return FollowedPath(self.people)


class FollowedPath:
    """State of a mouth that is followed from frame to frame.

    Args:
        people: fit of the training people.
    """

    def __init__(self, people: PeopleFit) -> None:
        self._state, self._knots = FaceState(people, 2), people.horizons

    def update(self, mouth: NDArray[np.floating]) -> None:
        """Take in the mouth (3,) m in the next frame, 1/30 s after the one before."""
        self._state.take(path_series(mouth[None])[:, 0])
        self._state.remember(self._state.forecast())

    def forecast(self, recent: NDArray[np.floating], horizon: int) -> Floats:
        """Return the mouth (H, 3) m in the frames after ``recent`` (W, 3), the newest last.

        These are 1/30 s apart, and need not be frames that were taken in.

        Raises:
            RequestError: the horizon is longer than 24.
        """
        require_horizon(horizon)
        made = self._state.forecast(path_series(recent)).moved[..., :2]
        across, depth = FACE_SIDE * every_frame(made, self._knots, horizon)
        return recent[-1] + np.column_stack([depth[:, 0], across])


def fit_paths(paths: NDArray[np.floating]) -> PathPredictor:
    """Fit residual prediction to paths (E, T, 3) m, each of another person.

    Coefficients are rounded to six digits, so that the number of threads of BLAS, which sums in
    another order, changes nothing.

    Raises:
        RequestError: they are fewer than four.
    """
    if len(paths) < LEAST_PEOPLE:
        raise RequestError(f"paths of {len(paths)} people; residual needs {LEAST_PEOPLE} or more")
    count = 3 * len(paths) // 4
    fitted, held_out = (
        [series for path in part for series in path_series(path)]
        for part in (paths[:count], paths[count:])
    )
    people = fit_people(fitted, [str(number // 2) for number in range(len(fitted))], EXPERTS)
    people = replace(
        people,
        linear=tuple(
            replace(
                fit,
                people=_rounded(fit.people),
                precision=None if fit.precision is None else _rounded(fit.precision),
            )
            for fit in people.linear
        ),
    )
    no_shapes = np.zeros((SHAPES, 2 * NUM_LANDMARKS))
    tried = trial(ResidualFit(no_shapes, people, IntervalFit.unknown()), held_out)
    made, mixed = ([pair[part] for pair in tried] for part in range(2))
    usual = usual_errors(made, mixed, held_out, people.pace)
    return PathPredictor(replace(people, usual=_rounded(usual)))


def path_series(path: NDArray[np.floating]) -> Floats:
    """Series (2, T, 4) in face sides of a path (T, 3) m: across the view, and of the depth.

    The mouth, and the shapes, which move as it does.
    """
    series = np.zeros((2, len(path), 4))
    series[0, :, :2] = path[:, 1:]
    series[1, :, 0] = path[:, 0]
    series[..., 2:] = series[..., :2]
    return series / FACE_SIDE


def _rounded(values: Floats) -> Floats:
    """The values with six significant digits."""
    with np.errstate(divide="ignore"):
        size = np.floor(np.log10(np.abs(values)))
    unit = 10.0 ** np.where(np.isfinite(size), size - _DIGITS + 1, 0.0)
    return np.round(values / unit) * unit
