"""Autoregression on displacements: of the mouth centre, and of all landmarks.

Both forecast how far things move from frame to frame, from how far they moved before
(`least_squares`), and add that to the last frame. Order (and components) are those that forecast
subjects held out best, at horizons of 1 to 5 frames together.

Legend: N sequences, B batch, T frames, H horizon, L landmarks, P order, D components.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.forecast.interface import Array, Forecaster, LandmarkSequences
from face_prediction.forecast.least_squares import (
    choose,
    forecast,
    moments,
    require_order,
    solve,
)
from face_prediction.forecast.mouth import mouth_centre
from face_prediction.tracks import NUM_LANDMARKS

if TYPE_CHECKING:
    from typing_extensions import Self

#: The paper's horizon: frames 71 to 75
HORIZON = 5
MOUTH_ORDERS = (1, 2, 3, 4, 6, 8, 12, 16)
LANDMARK_ORDERS = (1, 2, 3, 4, 6)
#: Shapes of displacement kept; a rigid head that moves parallel to the image has two.
COMPONENTS = (2, 4, 8, 16)
#: Every so many frames of a sequence one enters the principal components: neighbours are alike.
_SHAPE_STRIDE = 5


@dataclass(frozen=True)
class MouthAutoregression(Forecaster):
    """The face moves as a whole by what autoregression on the mouth centre expects."""

    #: (P, 2, 2): the displacement k frames ago, as a row (u, v), times ``coefficients[k - 1]``
    coefficients: NDArray[np.float64]

    name = "ar_mouth"

    def __post_init__(self) -> None:
        _check_coefficients(self.name, self.coefficients, 2)

    @classmethod
    def fit(cls, sequences: LandmarkSequences, order: int | None = None) -> Self:
        """Fit to the mouth centres, with ``order`` or the best of `MOUTH_ORDERS`.

        Raises:
            RequestError: the sequences are too short, or of one subject and no order is given.
        """
        steps = np.diff(mouth_centre(sequences.landmarks), axis=1)
        if order is None:
            pairs = [(p, 2) for p in _possible(MOUTH_ORDERS, steps.shape[1])]
            order, _ = choose(steps, steps, np.eye(2), sequences.subjects, pairs, HORIZON)
        require_order(order, steps.shape[1])
        return cls(solve(moments(steps, order), order, 2))

    @property
    def memory(self) -> int:
        """The last frame and one for every lag."""
        return len(self.coefficients) + 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        steps = np.diff(mouth_centre(history), axis=1)
        shift = np.cumsum(forecast(self.coefficients, steps, horizon), axis=1)
        return history[:, -1:].astype(np.float64) + shift[:, :, None]


@dataclass(frozen=True)
class LandmarkAutoregression(Forecaster):
    """Autoregression on the principal components of all landmarks' displacements."""

    #: (P, D, D)
    coefficients: NDArray[np.float64]
    #: (D, 2 L) orthonormal rows: u and v of landmark 0, of landmark 1, ...
    basis: NDArray[np.float64]

    name = "ar_landmarks"

    def __post_init__(self) -> None:
        components = len(self.basis)
        _check_coefficients(self.name, self.coefficients, components)
        if self.basis.shape != (components, 2 * NUM_LANDMARKS):
            raise RequestError(
                f"{self.name}: basis {self.basis.shape}; expected (any, {2 * NUM_LANDMARKS})"
            )

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
            pairs = product(orders, [d for d in COMPONENTS if d <= len(basis)])
            order, components = choose(steps, mouth, readout, sequences.subjects, pairs, HORIZON)
        require_order(order, steps.shape[1])
        components = min(components, len(basis))
        fitted = solve(moments(steps[..., :components], order), order, components)
        return cls(fitted, basis[:components])

    @property
    def memory(self) -> int:
        """The last frame and one for every lag."""
        return len(self.coefficients) + 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        flat = history.reshape(*history.shape[:2], -1).astype(np.float64)
        steps = np.diff(flat @ self.basis.T, axis=1)
        shift = np.cumsum(forecast(self.coefficients, steps, horizon), axis=1) @ self.basis
        ahead = flat[:, -1:] + shift
        return ahead.reshape(len(history), horizon, *history.shape[2:])


def principal_shapes(landmarks: Array, components: int) -> NDArray[np.float64]:
    """Orthonormal rows (D, 2 L): how landmarks (N, T, L, 2) leave their sequence's mean.

    The D <= ``components`` directions of most variance, most first; each has its largest entry
    positive, so that the same data give the same signs.
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


def _check_coefficients(name: str, coefficients: NDArray[np.float64], components: int) -> None:
    shape = coefficients.shape
    if len(shape) != 3 or shape[0] < 1 or shape[1:] != (components, components):
        raise RequestError(
            f"{name}: coefficients {shape}; expected (order, {components}, {components})"
        )
