"""Errors over all landmarks, as a share of the distance between the eyes.

Legend: N sequences, H horizon, L = 468 landmarks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError

#: The outer corners of the eyes (the subject's right and left) in MediaPipe's face mesh: the
#: normaliser of the 300-W benchmark (Sagonas et al. 2013).
OUTER_EYE_CORNERS = (33, 263)


def interocular_distances(landmarks: NDArray[np.floating]) -> NDArray[np.float64]:
    """Distances (...) between the outer eye corners of landmarks (..., L, 2)."""
    right, left = (landmarks[..., corner, :2] for corner in OUTER_EYE_CORNERS)
    return np.linalg.norm(np.asarray(right - left, dtype=np.float64), axis=-1)


def normalised_mean_errors(
    forecast: NDArray[np.floating], truth: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Mean distance (N, H) over landmarks / true distance between the eyes in that frame.

    NaN where the forecast holds NaN.

    Raises:
        RequestError: the shapes differ, or the eyes of a true face coincide.
    """
    if forecast.shape != truth.shape or truth.ndim != 4:
        raise RequestError(
            f"forecast of shape {forecast.shape} and truth of shape {truth.shape}; expected the "
            "same (sequences, horizon, landmarks, 2)"
        )
    apart = interocular_distances(truth)
    if not np.all(apart > 0):
        raise RequestError("truth: a face whose eye corners (33 and 263) coincide or are NaN")
    distance = np.linalg.norm(np.asarray(forecast - truth, dtype=np.float64), axis=-1)
    return distance.mean(axis=-1) / apart
