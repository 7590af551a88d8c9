"""Errors of forecast images (SSIM), and coverage of the intervals that predictors give.

Legend: B sequences of images, N sequences, H horizon, S side of the images; the last axis of
residuals and levels holds U and V. NaN stands for a missing forecast.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

SSIM_SIGMA = 1.5
"""Standard deviation (pixels) of the Gaussian window of Wang et al. 2004, which scikit-image cuts
off at 3.5 of them: 11 pixels across, as in that paper."""
SSIM_WINDOW = 11
"""Side (pixels) of that window: the smallest image that has a similarity."""
LEVELS = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Nominal coverages that are compared with observed ones: 0.05 to 0.95."""


def similarities(forecast: NDArray[np.uint8], truth: NDArray[np.uint8]) -> Floats:
    """SSIM (B, H) of images (B, H, S, S, 3): the mean over the image and the three colours.

    Of scikit-image, with the settings of Wang, Bovik, Sheikh and Simoncelli (2004): a Gaussian
    window with a standard deviation of 1.5 pixels, and population covariances.

    Raises:
        RequestError: scikit-image is not installed, the shapes differ, or the images are smaller
            than the window.
    """
    if forecast.shape != truth.shape or truth.ndim != 5 or truth.shape[2] < SSIM_WINDOW:
        raise RequestError(
            f"images of shape {forecast.shape} against {truth.shape}; expected the same "
            f"(sequences, horizon, size, size, 3), of {SSIM_WINDOW} pixels or more"
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
            sigma=SSIM_SIGMA,
            use_sample_covariance=False,
            data_range=255,
            channel_axis=-1,
        )
    return result


def area_average(images: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Images (B, H, S, S, 3) at side ``size``: each pixel the mean of those that it covers.

    Raises:
        RequestError: S is no multiple of ``size``.
    """
    side = images.shape[2]
    if side == size:
        return images
    if size < 1 or side % size:
        raise RequestError(f"images of {side} pixels cannot be averaged to {size}")
    step = side // size
    blocks = images.reshape(*images.shape[:2], size, step, size, step, 3)
    return np.rint(blocks.astype(np.float32).mean(axis=(3, 5))).astype(np.uint8)


def interval_levels(
    residuals: NDArray[np.floating],
    scale: NDArray[np.floating],
    degrees_of_freedom: NDArray[np.floating],
) -> Floats:
    """The level (N, H, 2) of the central interval that just reaches each true value, 0 to 1.

    An interval of nominal coverage p covers where this is at most p.

    Args:
        residuals: (N, H, 2) forecast minus truth.
        scale: (N, H, 2) of a Student-t error, in the same unit.
        degrees_of_freedom: (H, 2) of it; infinite: a Gaussian.

    Raises:
        RequestError: shapes differ, or a scale or a number of degrees is not positive.
    """
    from scipy import stats  # not at the top: the command line starts without it

    if scale.shape != residuals.shape or degrees_of_freedom.shape != residuals.shape[1:]:
        raise RequestError(
            f"scale {scale.shape} and degrees of freedom {degrees_of_freedom.shape} for residuals "
            f"of shape {residuals.shape}"
        )
    if not (np.all(scale > 0) and np.all(degrees_of_freedom > 0)):
        raise RequestError("intervals: a scale or a number of degrees of freedom is not positive")
    distance = np.abs(np.asarray(residuals, dtype=np.float64)) / scale
    return np.asarray(2 * stats.t.cdf(distance, degrees_of_freedom) - 1)


def coverage(levels: NDArray[np.floating], nominal: tuple[float, ...] = LEVELS) -> Floats:
    """Share (..., K) of U and V inside the interval of each ``nominal`` coverage: 0, 1/2 or 1.

    Args:
        levels: (..., 2) from `interval_levels`.
        nominal: K levels.
    """
    inside = np.mean(levels[..., None] <= np.array(nominal), axis=-2)
    known = np.isfinite(levels).all(axis=-1)
    return np.where(np.expand_dims(known, -1), inside, np.nan)
