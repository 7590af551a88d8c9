"""Errors of the forecast mouth centre, in crops (Tables I and II of the paper).

Signs: forecast minus truth. A frame without a forecast (the detector found no face in the image
that was forecast) is NaN, and is counted, not averaged.

Legend: N sequences, H horizon, L landmarks; the last axis holds U and V.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.forecast.mouth import mouth_centre

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MouthErrors:
    """Mean and variance (of the frames, not of an estimate) of abs dU and abs dV."""

    #: (H, 2) for each forecast frame: Table II
    mean: Floats
    variance: Floats
    #: (2,) over all forecast frames together: Table I
    pooled_mean: Floats
    pooled_variance: Floats
    #: (H,) forecasts there were, and forecasts there should have been but were not
    forecasts: NDArray[np.int64]
    missing: NDArray[np.int64]


def mouth_residuals(forecast: NDArray[np.floating], truth: NDArray[np.floating]) -> Floats:
    """Signed errors (N, H, 2) of the mouth centre, of landmarks (N, H, L, 2).

    Raises:
        RequestError: the shapes differ, or the truth holds NaN or infinity.
    """
    if forecast.shape != truth.shape or truth.ndim != 4 or truth.shape[-1] != 2:
        raise RequestError(
            f"forecast of shape {forecast.shape} and truth of shape {truth.shape}; expected the "
            "same (sequences, horizon, landmarks, 2)"
        )
    true_centre = mouth_centre(truth)
    if not np.all(np.isfinite(true_centre)):
        raise RequestError("truth: NaN or infinity in the mouth; leave such sequences out")
    return mouth_centre(forecast) - true_centre


def mouth_errors(residuals: Floats) -> MouthErrors:
    """Mean and variance of the absolute ``residuals`` (N, H, 2).

    What no forecast contributes to is NaN in the result.
    """
    there = has_forecast(residuals)
    size = np.abs(residuals)
    per_frame = [_mean_and_variance(size[there[:, h], h]) for h in range(residuals.shape[1])]
    pooled_mean, pooled_variance = _mean_and_variance(size[there])
    return MouthErrors(
        mean=np.stack([mean for mean, _ in per_frame]),
        variance=np.stack([variance for _, variance in per_frame]),
        pooled_mean=pooled_mean,
        pooled_variance=pooled_variance,
        forecasts=there.sum(axis=0),
        missing=(~there).sum(axis=0),
    )


def mouth_distances(residuals: Floats) -> Floats:
    """Distances (N, H) between forecast and true mouth centre; NaN where there is no forecast."""
    return np.linalg.norm(residuals, axis=-1)


def skill(errors: NDArray[np.floating], reference: NDArray[np.floating]) -> Floats:
    """1 - mean error / mean error of the reference (H,), of errors (N, H) of the same sequences.

    1 is a perfect forecast, 0 one no better than the reference (persistence, as a rule). Sequences
    that either has no forecast of are left out of both; a reference without error gives NaN.

    Raises:
        RequestError: the shapes differ.
    """
    if errors.shape != reference.shape:
        raise RequestError(f"errors {errors.shape} against a reference of {reference.shape}")
    both = np.isfinite(errors) & np.isfinite(reference)
    ours = np.where(both, errors, 0.0).sum(axis=0, dtype=np.float64)
    theirs = np.where(both, reference, 0.0).sum(axis=0, dtype=np.float64)
    return 1.0 - np.divide(ours, theirs, out=np.full_like(ours, np.nan), where=theirs > 0)


def has_forecast(residuals: Floats) -> NDArray[np.bool_]:
    """Where (N, H) there is a forecast.

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


def _mean_and_variance(values: Floats) -> tuple[Floats, Floats]:
    if len(values) == 0:
        return np.full(2, np.nan), np.full(2, np.nan)
    return values.mean(axis=0), values.var(axis=0)
