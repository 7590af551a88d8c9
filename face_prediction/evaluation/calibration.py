"""Whether intervals hold what they promise: nominal against observed coverage.

Legend: N sequences, H horizon; the last axis holds U and V.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

#: Nominal coverage that is looked at: 0.05 to 0.95.
LEVELS = tuple(round(0.05 * step, 2) for step in range(1, 20))


def interval_levels(
    residuals: NDArray[np.floating],
    scale: NDArray[np.floating],
    degrees_of_freedom: NDArray[np.floating],
) -> Floats:
    """The level (N, H, 2) of the central interval that just reaches each true value, 0 to 1.

    An interval of nominal coverage p covers where this is at most p. NaN where there is no
    forecast.

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


def covered(levels: NDArray[np.floating], nominal: tuple[float, ...] = LEVELS) -> Floats:
    """Share (N, H, K) of U and V that intervals of each ``nominal`` coverage hold: 0, 1/2 or 1.

    NaN where there is no forecast.

    Args:
        levels: (N, H, 2) from `interval_levels`.
        nominal: K levels.
    """
    inside = np.mean(levels[..., None] <= np.array(nominal), axis=-2)
    known = np.isfinite(levels).all(axis=-1)
    return np.where(np.expand_dims(known, -1), inside, np.nan)
