"""Intervals of residual prediction: the size of the next error, and how often it is exceeded.

The size of the mouth's error is estimated from four logarithms (`StateForecast.signs`): the errors
on this face so far, those of the last frames, the speed now, and how far the experts are apart. The
ratio of an error to that size has quantiles, which are measured on people that the coefficients
were not fitted to, and then move with each outcome on the watched face, so that the share that is
exceeded becomes what was promised (adaptive conformal inference: Gibbs and Candes 2021; the
quantile itself moves, as in Angelopoulos, Candes and Tibshirani 2023).

Shapes: N faces or rows, H horizons, S signs, Q levels; an axis of 2 holds U and V.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.models.residual.adaptive import HORIZONS, Ring
from face_prediction.models.residual.experts import Floats

SIGNS = 4
"""S."""
LEVELS = (0.5, 0.9)
"""Q nominal coverages that are measured and followed; a Student-t density through both gives the
others."""
RATE = 0.2
"""Change of the logarithm of a quantile with each outcome one frame ahead; h frames ahead, where
neighbouring outcomes overlap and come late, an h-th of it."""
_LEAST_ERROR = 1e-5  # face sides, added to errors before their logarithm is taken
_FREEDOM = np.geomspace(1.05, 60.0, 40)


@dataclass(frozen=True)
class IntervalFit:
    """Size of errors, and quantiles of their ratio to it, on training people.

    Attributes:
        size: (H, 2, S + 1) coefficients of the logarithm of an error, a constant last.
        quantiles: (H, 2, Q) of the logarithm of the ratio.
    """

    size: Floats
    quantiles: Floats

    def log_sizes(self, signs: Floats) -> Floats:
        """Logarithms (..., H, 2) of the sizes of errors, from signs (..., H, S)."""
        slopes = self.size[..., :-1]
        return np.einsum("...hs,has->...ha", signs, slopes) + self.size[..., -1]

    @classmethod
    def unknown(cls) -> IntervalFit:
        """Return one for forecasts whose intervals are not used."""
        count = len(HORIZONS)
        return cls(np.zeros((count, 2, SIGNS + 1)), np.zeros((count, 2, len(LEVELS))))

    def until(self, count: int) -> IntervalFit:
        """Return the part of the first ``count`` horizons."""
        return IntervalFit(self.size[:count], self.quantiles[:count])


def measure_intervals(signs: Floats, errors: Floats) -> IntervalFit:
    """Fit sizes and quantiles to signs (N, H, S) and errors (N, H, 2), NaN where there is none."""
    count = signs.shape[1]
    size = np.empty((count, 2, SIGNS + 1))
    quantiles = np.empty((count, 2, len(LEVELS)))
    for horizon in range(count):
        known = np.isfinite(errors[:, horizon, 0])
        rows = np.concatenate([signs[known, horizon], np.ones((int(known.sum()), 1))], axis=1)
        logs = np.log(np.abs(errors[known, horizon]) + _LEAST_ERROR)  # (n, 2)
        solution = np.linalg.lstsq(rows, logs, rcond=None)[0]
        size[horizon] = solution.T
        quantiles[horizon] = np.quantile(logs - rows @ solution, LEVELS, axis=0).T
    return IntervalFit(size, quantiles)


class IntervalTracker:
    """Quantiles of N faces, that move with each outcome.

    Args:
        fit: of the training people.
        faces: N.
        memory: frames between a forecast and its outcome at most.
    """

    def __init__(self, fit: IntervalFit, faces: int, memory: int) -> None:
        self.fit = fit
        self._quantiles = np.repeat(fit.quantiles[None], faces, axis=0)
        self._past = Ring(memory, (faces, *fit.quantiles.shape[:2]))

    def keep(self, faces: int) -> None:
        """Go on with the first so many faces."""
        self._quantiles = self._quantiles[:faces]
        self._past.keep(faces)

    def learn(self, errors: Floats, ages: NDArray[np.int64]) -> None:
        """Learn from the errors (N, K, 2) of the forecasts that were made ``ages`` (K,) ago."""
        known = slice(len(ages))
        made = self._past.of_horizons(ages)  # (N, K, 2)
        ratio = np.log(np.abs(errors) + _LEAST_ERROR) - made
        exceeds = ratio[..., None] > self._quantiles[:, known]
        rates = (RATE / ages)[:, None, None]
        self._quantiles[:, known] += rates * (exceeds - (1 - np.array(LEVELS)))

    def remember(self, signs: Floats) -> None:
        """Keep the sizes estimated with a forecast, to learn from its outcome."""
        self._past.push(self.fit.log_sizes(signs))

    def student_t(self, signs: Floats) -> tuple[Floats, Floats]:
        """Scale and degrees of freedom (N, H, 2 each) of the errors."""
        return student_t(self.fit.log_sizes(signs)[..., None] + self._quantiles)


def student_t(logs: Floats) -> tuple[Floats, Floats]:
    """Scale and degrees of freedom (...) of the Student-t density with absolute quantiles `LEVELS`.

    Args:
        logs: (..., Q) logarithms of the quantiles. Where their ratio is beyond what densities from
            nearly Gaussian to nearly Cauchy have, the geometric mean is kept.
    """
    middle, far = _student_quantiles()
    ratio = np.clip(logs[..., 1] - logs[..., 0], far[-1] - middle[-1], far[0] - middle[0])
    freedom = np.exp(np.interp(-ratio, middle - far, np.log(_FREEDOM)))
    both = [np.interp(freedom, _FREEDOM, values) for values in (middle, far)]
    scale = np.exp((logs[..., 0] - both[0] + logs[..., 1] - both[1]) / 2)
    return scale, freedom


def _student_quantiles() -> tuple[Floats, Floats]:
    """Logarithms of the quantiles of the absolute value at `LEVELS`, for each of `_FREEDOM`."""
    from scipy import stats  # not at the top: the command line starts without it

    middle, far = (np.log(stats.t.ppf((1 + level) / 2, _FREEDOM)) for level in LEVELS)
    return middle, far
