"""Errors over all landmarks, as a share of the distance between the eyes.

Legend: N sequences, H horizon, L = 468 landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import mouth_centre
from robo_manip_baselines.runs.errors import RequestError

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


#: Standard deviation (pixels) of the Gaussian window of Wang et al. 2004, which scikit-image cuts
#: off at 3.5 of them: 11 pixels across, as in that paper.
SIGMA = 1.5
#: Side (pixels) of that window: the smallest picture that has a similarity.
SMALLEST = 11


def similarities(forecast: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """SSIM (B, H) of pictures (B, H, S, S, 3): the mean over the picture and the three colours.

    Of scikit-image, with the settings of Wang, Bovik, Sheikh and Simoncelli (2004): a Gaussian
    window with a standard deviation of 1.5 pixels, and population covariances.

    Raises:
        RequestError: scikit-image is not installed, the shapes differ, or the pictures are smaller
            than the window.
    """
    if forecast.shape != truth.shape or truth.ndim != 5 or truth.shape[2] < SMALLEST:
        raise RequestError(
            f"pictures of shape {forecast.shape} against {truth.shape}; expected the same "
            f"(sequences, horizon, size, size, 3), of {SMALLEST} pixels or more"
        )
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise RequestError(
            f"SSIM needs scikit-image ({error}); pip install "
            "'robo_manip_baselines[face_prediction]'"
        ) from None
    ours, true = forecast.astype(np.float32), truth.astype(np.float32)
    result = np.empty(truth.shape[:2])
    for place in np.ndindex(result.shape):
        result[place] = structural_similarity(
            ours[place],
            true[place],
            gaussian_weights=True,
            sigma=SIGMA,
            use_sample_covariance=False,
            data_range=255,
            channel_axis=-1,
        )
    return result


def area_average(pictures: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Pictures (B, H, S, S, 3) at side ``size``: each pixel the mean of those that it covers.

    Raises:
        RequestError: S is no multiple of ``size``.
    """
    side = pictures.shape[2]
    if side == size:
        return pictures
    if size < 1 or side % size:
        raise RequestError(f"pictures of {side} pixels cannot be averaged to {size}")
    step = side // size
    blocks = pictures.reshape(*pictures.shape[:2], size, step, size, step, 3)
    mean = blocks.astype(np.float32).mean(axis=(3, 5))
    return np.rint(mean).astype(np.uint8)
