"""Vector autoregression by least squares: fitting, stability, forecasting.

x[t] = sum over k = 1..P of x[t - k] @ A[k - 1] + noise, without a constant: x are displacements
from frame to frame, and a drift learnt from other series does not apply to this one.

Legend: N series, T frames, P order, D components, H horizon, B batch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RIDGE = 1e-6
"""Share of the regressors' mean square that is added to the diagonal: keeps still faces solvable
and changes coefficients by parts in a million."""
MAX_RADIUS = 0.99
"""Largest modulus of an eigenvalue; a displacement then halves within 70 frames at the latest."""


def moments(series: Floats, order: int) -> Floats:
    """Moments (P, D, P + 1, D) of ``series`` (N, T, D), summed over frames.

    Products of the value k frames ago (k - 1 along the first axis) with the present value (0 along
    the third axis) and with the values 1...P frames ago.
    """
    size, components = series.shape[1:]
    lagged = [series[:, order - k : size - k] for k in range(1, order + 1)]  # P of (N, T - P, D)
    rows = np.stack(lagged, axis=2).reshape(-1, order * components)
    target = series[:, order:].reshape(-1, components)
    shape = (order, components, -1, components)
    products = [(rows.T @ columns).reshape(shape) for columns in (target, rows)]
    return np.concatenate(products, axis=2)


def solve(sums: Floats, order: int, components: int) -> Floats:
    """Coefficients (P, D, D) of the first ``order`` lags and ``components`` components; stable."""
    size = order * components
    used = sums[:order, :components, : order + 1, :components]
    cross = used[:, :, 1:].reshape(size, size)
    ridge = RIDGE * max(np.trace(cross) / size, np.finfo(float).tiny)
    solved = np.linalg.solve(cross + ridge * np.eye(size), used[:, :, 0].reshape(size, components))
    return stabilised(solved.reshape(order, components, components))


def spectral_radius(coefficients: Floats) -> float:
    """Largest modulus of the eigenvalues of the companion matrix of (P, D, D)."""
    order, components = coefficients.shape[:2]
    companion = np.zeros((order * components,) * 2)
    companion[:, :components] = coefficients.reshape(-1, components)
    companion[:-components, components:] = np.eye((order - 1) * components)
    return float(np.abs(np.linalg.eigvals(companion)).max())


def stabilised(coefficients: Floats, limit: float = MAX_RADIUS) -> Floats:
    """The same, or with A[k] times (limit / radius)^k, which moves every eigenvalue inside."""
    radius = spectral_radius(coefficients)
    if radius <= limit:
        return coefficients
    lags = np.arange(1, len(coefficients) + 1)
    return coefficients * ((limit / radius) ** lags)[:, None, None]


def forecast(coefficients: Floats, recent: Floats, horizon: int) -> Floats:
    """Expected next values (B, H, D) after ``recent`` (B, any, D), the newest last.

    Before ``recent`` the series is taken to have been 0.
    """
    order = len(coefficients)
    newest_first = [recent[:, -k] for k in range(1, min(order, recent.shape[1]) + 1)]
    result = []
    for _ in range(horizon):
        terms = (x @ a for x, a in zip(newest_first, coefficients, strict=False))
        following = sum(terms, np.zeros((recent.shape[0], recent.shape[2])))
        result.append(following)
        newest_first.insert(0, following)
    return np.stack(result, axis=1)
