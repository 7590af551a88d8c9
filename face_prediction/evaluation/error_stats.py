"""Error statistics: what the robot's side is told of a predictor's errors.

All errors are forecast minus truth of the mouth centre, in crops, except those in metres.
Legend: H horizon, Q quantile levels, K lags, n forecasts of a run.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from face_prediction.errors import RequestError
from face_prediction.evaluation.camera import EQUATIONS, Camera

#: Relative agreement asked of numbers that follow from others in the file
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of one forecast frame; pairs are (U, V)."""

    #: frames ahead, 1 is the next
    frames: int
    #: forecasts there were, and forecasts there should have been but were not
    forecasts: int
    missing: int
    #: mean and variance of the absolute errors, and mean of the signed ones
    mean_abs: tuple[float, ...]
    var_abs: tuple[float, ...]
    bias: tuple[float, ...]
    #: (2, Q) quantiles of the signed errors at ``quantile_levels``
    quantiles: tuple[tuple[float, ...], ...]
    #: equations 6 and 7 of ``mean_abs``: (across, up) in metres
    mean_abs_m: tuple[float, ...]


@dataclass(frozen=True)
class ResidualRun:
    """Signed errors of forecasts made one after another, ``stride_frames`` apart, in one clip."""

    clip: str
    subject: str
    #: (n, H, 2)
    values: tuple[tuple[tuple[float, ...], ...], ...]


@dataclass(frozen=True)
class ErrorStats:
    """Everything in one file.

    Raises:
        RequestError: a number breaks what is promised here; the message names the key.
    """

    predictor: str
    #: kind of footage, for people to read
    footage: str
    #: frames a second of the forecasts
    fps: float
    #: frames between one forecast of a clip and the next
    stride_frames: int
    #: sequences and people that were measured
    sequences: int
    subjects: int
    #: SHA-256 of the truth and the forecasts
    data_sha256: str
    camera: Camera
    equations: tuple[str, ...]
    quantile_levels: tuple[float, ...]
    #: H of them, 1 to H frames ahead
    horizons: tuple[HorizonErrors, ...]
    #: (2 H, 2 H) of the signed errors of one sequence, in the order 1 U, 1 V, 2 U, ...
    covariance: tuple[tuple[float, ...], ...]
    #: (K, H, 2) between forecasts k strides apart in one clip, k = 0 ... K - 1
    autocorrelation: tuple[tuple[tuple[float, ...], ...], ...]
    #: runs to resample; may be none
    residuals: tuple[ResidualRun, ...] = ()

    def __post_init__(self) -> None:
        _require(bool(self.predictor), "predictor", "must be named")
        _require(_positive(self.fps), "fps", "must be positive")
        _require(self.stride_frames >= 1, "stride_frames", "must be 1 or more")
        _require(1 <= self.subjects <= self.sequences, "subjects", "must be 1 to 'sequences'")
        _require(
            re.fullmatch("[0-9a-f]{64}", self.data_sha256) is not None,
            "data_sha256",
            "must be 64 hexadecimal digits",
        )
        _require(self.equations == EQUATIONS, "equations", f"must be {list(EQUATIONS)}")
        levels = self.quantile_levels
        _require(
            len(levels) > 0 and _rising((0.0, *levels, 1.0)),
            "quantile_levels",
            "must rise, between 0 and 1",
        )
        frames = [horizon.frames for horizon in self.horizons]
        size = len(frames)
        _require(
            size > 0 and frames == list(range(1, size + 1)), "horizons", "must be 1, 2, ... frames"
        )
        for horizon in self.horizons:
            _check_horizon(horizon, self.camera, len(levels), self.sequences)
        _check_covariance(_array(self.covariance, "covariance"), size)
        lags = _array(self.autocorrelation, "autocorrelation")
        _require(
            lags.ndim == 3 and lags.shape[1:] == (size, 2) and _all_finite(lags),
            "autocorrelation",
            f"must be finite and of shape (lags, {size}, 2)",
        )
        for index, run in enumerate(self.residuals):
            values = _array(run.values, f"residuals[{index}]")
            _require(
                values.ndim == 3 and values.shape[1:] == (size, 2) and _all_finite(values),
                f"residuals[{index}]",
                f"must be finite and of shape (forecasts, {size}, 2)",
            )


def _check_horizon(horizon: HorizonErrors, camera: Camera, levels: int, sequences: int) -> None:
    where = f"horizons[{horizon.frames - 1}]"
    pairs = {
        key: _array(getattr(horizon, key), f"{where}.{key}")
        for key in ("mean_abs", "var_abs", "bias", "mean_abs_m")
    }
    for key, pair in pairs.items():
        _require(pair.shape == (2,) and _all_finite(pair), f"{where}.{key}", "must be two numbers")
        _require(key == "bias" or bool(np.all(pair >= 0)), f"{where}.{key}", "must not be negative")
    slack = 1 + _TOLERANCE
    _require(
        bool(np.all(np.abs(pairs["bias"]) <= pairs["mean_abs"] * slack)),
        f"{where}.bias",
        "must not exceed 'mean_abs'",
    )
    _require(
        np.allclose(camera.metres(pairs["mean_abs"]), pairs["mean_abs_m"], _TOLERANCE, 0.0),
        f"{where}.mean_abs_m",
        "does not follow from 'mean_abs' and 'camera'",
    )
    quantiles = _array(horizon.quantiles, f"{where}.quantiles")
    _require(
        quantiles.shape == (2, levels)
        and _all_finite(quantiles)
        and bool(np.all(np.diff(quantiles, axis=1) >= 0)),
        f"{where}.quantiles",
        f"must be two rising lists of {levels}",
    )
    _require(
        horizon.forecasts >= 1
        and horizon.missing >= 0
        and horizon.forecasts + horizon.missing == sequences,
        f"{where}.forecasts",
        "must be 1 or more and with 'missing' make 'sequences'",
    )


def _check_covariance(covariance: np.ndarray, horizons: int) -> None:
    size = 2 * horizons
    _require(
        covariance.shape == (size, size) and _all_finite(covariance),
        "covariance",
        f"must be finite and {size} x {size}",
    )
    _require(
        bool(np.array_equal(covariance, covariance.T))
        and bool(np.linalg.eigvalsh(covariance)[0] >= -_TOLERANCE * np.trace(covariance)),
        "covariance",
        "must be symmetric without negative eigenvalues",
    )


def _array(values: object, key: str) -> np.ndarray:
    """Nested tuples of numbers as an array."""
    try:
        return np.array(values, dtype=np.float64)
    except ValueError:
        raise RequestError(f"'{key}' has rows of different lengths") from None


def _require(holds: bool, key: str, what: str) -> None:
    if not holds:
        raise RequestError(f"'{key}' {what}")


def _positive(value: float) -> bool:
    return math.isfinite(value) and value > 0


def _rising(values: tuple[float, ...]) -> bool:
    return all(a < b for a, b in pairwise(values))


def _all_finite(values: np.ndarray) -> bool:
    return bool(np.all(np.isfinite(values)))
