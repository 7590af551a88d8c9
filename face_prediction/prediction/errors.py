"""Errors of forecasts: of the mouth centre, and of all landmarks.

Legend: N sequences, H horizon, L = 468 landmarks; the last axis of residuals holds U and V, as
shares of the crop. NaN stands for a missing forecast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import mouth_centre
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

OUTER_EYE_CORNERS = (33, 263)
"""Outer corners of the subject's right and left eye in MediaPipe's face mesh: the normaliser of
the 300-W benchmark (Sagonas et al. 2013)."""


@dataclass(frozen=True)
class MouthErrors:
    """Mean and variance (of the frames, not of an estimate) of abs dU and abs dV.

    Attributes:
        mean: (H, 2) for each forecast frame: Table II.
        variance: (H, 2), likewise.
        pooled_mean: (2,) over all forecast frames together: Table I.
        pooled_variance: (2,), likewise.
        forecasts: (H,) number of forecasts.
        missing: (H,) number of missing forecasts.
    """

    mean: Floats
    variance: Floats
    pooled_mean: Floats
    pooled_variance: Floats
    forecasts: NDArray[np.int64]
    missing: NDArray[np.int64]


def mouth_residuals(forecast: NDArray[np.floating], truth: NDArray[np.floating]) -> Floats:
    """Signed errors (N, H, 2) of the mouth centre, of landmarks (N, H, L, 2).

    Raises:
        RequestError: the shapes differ, or the truth holds NaN or infinity.
    """
    _require_same_shape(forecast, truth)
    true_centre = mouth_centre(truth)
    if not np.all(np.isfinite(true_centre)):
        raise RequestError("truth: NaN or infinity in the mouth; leave such sequences out")
    return mouth_centre(forecast) - true_centre


def mouth_distances(residuals: Floats) -> Floats:
    """Distances (N, H) between forecast and true mouth centre."""
    return np.linalg.norm(residuals, axis=-1)


def mouth_errors(residuals: Floats) -> MouthErrors:
    """Mean and variance of the absolute ``residuals`` (N, H, 2), NaN where there is no forecast.

    Raises:
        RequestError: as `has_forecast` does.
    """
    known = has_forecast(residuals)
    size = np.abs(residuals)
    per_frame = [_mean_and_variance(size[known[:, h], h]) for h in range(residuals.shape[1])]
    pooled_mean, pooled_variance = _mean_and_variance(size[known])
    return MouthErrors(
        mean=np.stack([mean for mean, _ in per_frame]),
        variance=np.stack([variance for _, variance in per_frame]),
        pooled_mean=pooled_mean,
        pooled_variance=pooled_variance,
        forecasts=known.sum(axis=0),
        missing=(~known).sum(axis=0),
    )


def has_forecast(residuals: Floats) -> NDArray[np.bool_]:
    """Mask (N, H) of the forecasts that are not missing.

    Raises:
        RequestError: the residuals have another shape, there are none, or one is infinite.
    """
    if residuals.ndim != 3 or residuals.shape[-1] != 2 or 0 in residuals.shape:
        raise RequestError(
            f"residuals of shape {residuals.shape}; expected (sequences, horizon, 2)"
        )
    if np.any(np.isinf(residuals)):
        raise RequestError("residuals: infinity in them; a frame without a forecast is NaN")
    return np.asarray(~np.isnan(residuals).any(axis=-1))


def normalised_mean_errors(forecast: NDArray[np.floating], truth: NDArray[np.floating]) -> Floats:
    """Mean distance (N, H) over landmarks / true distance between the eyes in that frame.

    Raises:
        RequestError: the shapes differ, or the eyes of a true face coincide.
    """
    _require_same_shape(forecast, truth)
    right, left = (truth[..., corner, :] for corner in OUTER_EYE_CORNERS)
    between_eyes = np.linalg.norm(np.asarray(right - left, dtype=np.float64), axis=-1)
    if not np.all(between_eyes > 0):
        raise RequestError("truth: a face whose eye corners (33 and 263) coincide or are NaN")
    distance = np.linalg.norm(np.asarray(forecast - truth, dtype=np.float64), axis=-1)
    return distance.mean(axis=-1) / between_eyes


def _require_same_shape(forecast: NDArray[np.floating], truth: NDArray[np.floating]) -> None:
    if forecast.shape != truth.shape or truth.ndim != 4 or truth.shape[-1] != 2:
        raise RequestError(
            f"forecast of shape {forecast.shape} and truth of shape {truth.shape}; expected the "
            "same (sequences, horizon, landmarks, 2)"
        )


def _mean_and_variance(values: Floats) -> tuple[Floats, Floats]:
    if len(values) == 0:
        return np.full(2, np.nan), np.full(2, np.nan)
    return values.mean(axis=0), values.var(axis=0)
