"""Vector autoregression of faces: on mouth centres, on shapes of landmarks; choice of order.

The series are displacements from frame to frame, see `runs.autoregression`.

Legend: N sequences, T frames, P order, D components, H horizon, B batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import (
    Array,
    Forecaster,
    LandmarkSequences,
    mouth_centre,
    subject_folds,
)
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.autoregression import forecast, moments, solve
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self


Floats = NDArray[np.float64]

HORIZON = 5
"""The paper's horizon: frames 71 to 75."""
MOUTH_ORDERS = (1, 2, 3, 4, 6, 8, 12, 16)
LANDMARK_ORDERS = (1, 2, 3, 4, 6)
COMPONENTS = (2, 4, 8, 16)
"""Shapes of displacement kept; a rigid head that moves parallel to the image has two."""
FOLDS = 5
"""Parts that the subjects are divided into to choose an order."""
_ORIGIN_STEP = 10  # frames between the ends of the histories that orders are compared at
_ORIGINS = 4  # such histories in a sequence
_SHAPE_STRIDE = 5  # frames between those that enter the principal components: neighbours are alike


def held_out_errors(
    series: Floats,
    mouth: Floats,
    readout: Floats,
    subjects: tuple[str, ...],
    candidates: Sequence[tuple[int, int]],
    horizon: int,
) -> dict[tuple[int, int], float]:
    """Error of each (order, components) on subjects that were not fitted to.

    Args:
        series: (N, T, D) displacements, the components most worth keeping first.
        mouth: (N, T, 2) displacements of the mouth centre.
        readout: (D, 2) mouth displacement that each component stands for.
        subjects: N names.
        candidates: pairs to try.
        horizon: the error is the mean of abs dU and dV of the mouth centre over frames 1 to this.

    Raises:
        RequestError: all sequences are of one subject, or too short for the candidates.
    """
    longest = max(order for order, _ in candidates)
    if len(set(subjects)) < 2:
        needed = "an order is chosen on people held out: give 2 or more subjects, or the order"
        raise RequestError(f"sequences of 1 subject; {needed}")
    steps = series.shape[1]
    if steps - horizon < longest:
        needed = f"order {longest} and horizon {horizon} need {longest + horizon + 1} or more"
        raise RequestError(f"sequences of {steps + 1} frames; {needed}")
    # ends of histories, the last first, each with ``horizon`` steps after it
    origins = range(steps - horizon, longest - 1, -_ORIGIN_STEP)[:_ORIGINS]
    fold = subject_folds(subjects, FOLDS)
    parts = [moments(series[fold == f], longest) for f in range(fold.max() + 1)]
    whole = sum(parts[1:], parts[0])
    totals = dict.fromkeys(candidates, 0.0)
    for f, part in enumerate(parts):
        rest = whole - part
        for order, components in candidates:
            coefficients = solve(rest, order, components)
            for origin in origins:
                recent = series[fold == f, :origin, :components]
                ahead = forecast(coefficients, recent, horizon) @ readout[:components]
                true = mouth[fold == f, origin : origin + horizon]
                error = np.abs(np.cumsum(ahead - true, axis=1)).sum()
                totals[order, components] += float(error)
    count = len(series) * len(origins) * horizon * 2
    return {pair: total / count for pair, total in totals.items()}


def least_error(errors: Mapping[tuple[int, int], float]) -> tuple[int, int]:
    """The (order, components) of the least error; the smaller of equal ones."""
    return min(sorted(errors), key=errors.__getitem__)


def require_order(order: int, steps: int) -> None:
    """Raise RequestError unless ``steps`` displacements a sequence leave rows to fit ``order``."""
    if not 1 <= order < steps:
        needed = f"must be 1 to {steps - 1} for sequences of {steps + 1} frames"
        raise RequestError(f"order {order}: {needed}")


@dataclass(frozen=True)
class _Autoregression(Forecaster):
    coefficients: Floats

    @property
    def memory(self) -> int:
        """The last frame and one for every lag."""
        return len(self.coefficients) + 1

    def _check_coefficients(self, components: int) -> None:
        shape = self.coefficients.shape
        if len(shape) != 3 or shape[0] < 1 or shape[1:] != (components, components):
            expected = f"(order, {components}, {components})"
            raise RequestError(f"{self.name}: coefficients {shape}; expected {expected}")


@dataclass(frozen=True)
class MouthAutoregression(_Autoregression):
    """The face moves as a whole by the forecast displacement of the mouth centre.

    Attributes:
        coefficients: (P, 2, 2): the displacement k frames ago, as a row (u, v), times
            ``coefficients[k - 1]``.
    """

    name = "ar_mouth"

    def __post_init__(self) -> None:
        self._check_coefficients(2)

    @classmethod
    def fit(cls, sequences: LandmarkSequences, order: int | None = None) -> Self:
        """Fit to the mouth centres, with ``order`` or the best of `MOUTH_ORDERS`.

        Raises:
            RequestError: the sequences are too short, or of one subject and no order is given.
        """
        steps = np.diff(mouth_centre(sequences.landmarks), axis=1)
        if order is None:
            pairs = [(p, 2) for p in _possible(MOUTH_ORDERS, steps.shape[1])]
            errors = held_out_errors(steps, steps, np.eye(2), sequences.subjects, pairs, HORIZON)
            order, _ = least_error(errors)
        require_order(order, steps.shape[1])
        return cls(solve(moments(steps, order), order, 2))

    def _forecast(self, history: Array, horizon: int) -> Floats:
        steps = np.diff(mouth_centre(history), axis=1)
        shift = np.cumsum(forecast(self.coefficients, steps, horizon), axis=1)
        return history[:, -1:].astype(np.float64) + shift[:, :, None]


@dataclass(frozen=True)
class LandmarkAutoregression(_Autoregression):
    """Autoregression on the principal components of all landmarks' displacements.

    Attributes:
        coefficients: (P, D, D).
        basis: (D, 2 L) orthonormal rows: u and v of landmark 0, of landmark 1, ...
    """

    basis: Floats

    name = "ar_landmarks"

    def __post_init__(self) -> None:
        components = len(self.basis)
        self._check_coefficients(components)
        if self.basis.shape != (components, 2 * NUM_LANDMARKS):
            expected = f"(any, {2 * NUM_LANDMARKS})"
            raise RequestError(f"{self.name}: basis {self.basis.shape}; expected {expected}")

    @classmethod
    def fit(
        cls, sequences: LandmarkSequences, order: int | None = None, components: int = 8
    ) -> Self:
        """Fit with ``order`` and ``components``, or, without an order, with the best pair.

        Raises:
            RequestError: the sequences are too short, or of one subject and no order is given.
        """
        count = components if order is not None else max(COMPONENTS)
        basis = principal_shapes(sequences.landmarks, count)
        flat = sequences.landmarks.reshape(*sequences.landmarks.shape[:2], -1)
        steps = np.diff(flat @ basis.T, axis=1)  # (N, T - 1, D)
        if order is None:
            readout = mouth_centre(basis.reshape(len(basis), NUM_LANDMARKS, 2))
            mouth = np.diff(mouth_centre(sequences.landmarks), axis=1)
            orders = _possible(LANDMARK_ORDERS, steps.shape[1])
            pairs = list(product(orders, [d for d in COMPONENTS if d <= len(basis)]))
            errors = held_out_errors(steps, mouth, readout, sequences.subjects, pairs, HORIZON)
            order, components = least_error(errors)
        require_order(order, steps.shape[1])
        components = min(components, len(basis))
        fitted = solve(moments(steps[..., :components], order), order, components)
        return cls(fitted, basis[:components])

    def _forecast(self, history: Array, horizon: int) -> Floats:
        flat = history.reshape(*history.shape[:2], -1).astype(np.float64)
        steps = np.diff(flat @ self.basis.T, axis=1)
        shift = np.cumsum(forecast(self.coefficients, steps, horizon), axis=1) @ self.basis
        ahead = flat[:, -1:] + shift
        return ahead.reshape(len(history), horizon, *history.shape[2:])


def principal_shapes(landmarks: Array, components: int) -> Floats:
    """Principal components of landmarks (N, T, L, 2) about their sequence's mean: rows (D, 2 L).

    Orthonormal, the D <= ``components`` directions of most variance, most first; the largest entry
    of each is positive, so that the same data give the same signs.
    """
    some = landmarks[:, ::_SHAPE_STRIDE]
    apart = some - some.mean(axis=1, keepdims=True, dtype=np.float64)
    rows = apart.reshape(-1, 2 * NUM_LANDMARKS)
    _, vectors = np.linalg.eigh(rows.T @ rows)
    shapes = vectors[:, : -min(components, len(vectors)) - 1 : -1].T
    largest = np.abs(shapes).argmax(axis=1)
    return shapes * np.sign(shapes[np.arange(len(shapes)), largest])[:, None]


def _possible(orders: tuple[int, ...], steps: int) -> list[int]:
    """The orders that ``steps`` displacements a sequence allow; the smallest at least."""
    return [p for p in orders if p + HORIZON <= steps] or [min(orders)]
