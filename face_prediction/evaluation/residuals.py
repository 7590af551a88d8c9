"""What a predictor's residuals look like: from arrays to `ErrorStats`.

Legend: N sequences, H horizon, K lags, n forecasts of a run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.evaluation.camera import EQUATIONS, PAPER_CAMERA, Camera
from face_prediction.evaluation.error_stats import ErrorStats, HorizonErrors, ResidualRun
from face_prediction.evaluation.mouth_errors import Floats, has_forecast, mouth_errors

QUANTILE_LEVELS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
#: Strides that the autocorrelation is measured over, where a clip is long enough
MAX_LAG = 10
#: Decimals of residuals in a run: a millionth of a crop, finer than any detector
_DECIMALS = 6


def measure_error_stats(
    residuals: Floats,
    clips: Sequence[str],
    subjects: Sequence[str],
    starts: Sequence[int],
    *,
    predictor: str,
    footage: str,
    data_sha256: str,
    stride_frames: int,
    fps: float = 30.0,
    camera: Camera = PAPER_CAMERA,
    keep_runs: bool = True,
) -> ErrorStats:
    """Statistics of signed mouth residuals (N, H, 2) in crops; NaN where there is no forecast.

    Args:
        residuals: forecast minus truth.
        clips: N names of the clips that sequences come from.
        subjects: N names of people.
        starts: N frame numbers in their clips; sequences of a clip whose starts are
            ``stride_frames`` apart are neighbours, of which the autocorrelation speaks.
        predictor: what made the forecasts.
        footage: kind of footage.
        data_sha256: of truth and forecasts (`data_hash`).
        stride_frames: frames between neighbours.
        fps: rate of the forecasts.
        camera: what errors are converted to metres for.
        keep_runs: whether the file holds the residuals themselves, to be resampled.

    Raises:
        RequestError: lengths differ, or a horizon or the whole has no forecast.
    """
    there = has_forecast(residuals)
    if not len(residuals) == len(clips) == len(subjects) == len(starts):
        raise RequestError(
            f"{len(residuals)} residuals, {len(clips)} clips, {len(subjects)} subjects and "
            f"{len(starts)} starts; as many of each are needed"
        )
    complete = np.asarray(there.all(axis=1))
    if not complete.any():
        raise RequestError(f"{predictor}: no sequence has a forecast for every horizon")
    errors = mouth_errors(residuals)
    horizons = []
    for h in range(residuals.shape[1]):
        known = residuals[there[:, h], h]
        horizons.append(
            HorizonErrors(
                frames=h + 1,
                forecasts=int(errors.forecasts[h]),
                missing=int(errors.missing[h]),
                mean_abs=_nested(errors.mean[h]),
                var_abs=_nested(errors.variance[h]),
                bias=_nested(known.mean(axis=0)),
                quantiles=_nested(np.quantile(known, QUANTILE_LEVELS, axis=0).T),
                mean_abs_m=_nested(camera.metres(errors.mean[h])),
            )
        )
    runs = neighbours(clips, starts, stride_frames)
    kept = [part for run in runs for part in _whole_parts(run, complete)] if keep_runs else []
    return ErrorStats(
        predictor=predictor,
        footage=footage,
        fps=fps,
        stride_frames=stride_frames,
        sequences=len(residuals),
        subjects=len(set(subjects)),
        data_sha256=data_sha256,
        camera=camera,
        equations=EQUATIONS,
        quantile_levels=QUANTILE_LEVELS,
        horizons=tuple(horizons),
        covariance=_nested(_covariance(residuals[complete])),
        autocorrelation=_nested(autocorrelation(residuals, runs, MAX_LAG)),
        residuals=tuple(
            ResidualRun(
                clips[int(part[0])],
                subjects[int(part[0])],
                _nested(np.round(residuals[part], _DECIMALS)),
            )
            for part in kept
        ),
    )


def neighbours(clips: Sequence[str], starts: Sequence[int], stride: int) -> list[NDArray[np.intp]]:
    """Indices of sequences that follow one another in one clip, ``stride`` frames apart.

    Every sequence is in one run; a run may have one.
    """
    order = sorted(range(len(clips)), key=lambda i: (clips[i], starts[i]))
    runs: list[list[int]] = []
    for i in order:
        last = runs[-1][-1] if runs else None
        follows = last is not None and clips[last] == clips[i]
        if follows and last is not None and starts[i] - starts[last] == stride:
            runs[-1].append(i)
        else:
            runs.append([i])
    return [np.array(run) for run in runs]


def autocorrelation(residuals: Floats, runs: Sequence[NDArray[np.intp]], max_lag: int) -> Floats:
    """Correlation (K, H, 2) of residuals (N, H, 2) with those k places on in their run.

    The mean product of pairs about the mean of all, over the variance of all; k = 0 is 1. Lags
    stop where no pair is left; an axis without any variance has 0 at every k but 0.
    """
    about = residuals - np.nanmean(residuals, axis=0)
    variance = np.nanmean(about**2, axis=0)
    result = [np.ones_like(variance)]
    for lag in range(1, max_lag + 1):
        pairs = [about[run[lag:]] * about[run[:-lag]] for run in runs if len(run) > lag]
        products = np.concatenate(pairs) if pairs else np.empty((0, *variance.shape))
        if not np.all(np.isfinite(products).any(axis=0)):
            break
        mean = np.nanmean(products, axis=0)
        result.append(np.divide(mean, variance, out=np.zeros_like(mean), where=variance > 0))
    return np.stack(result)


def data_hash(*arrays: NDArray[np.generic]) -> str:
    """SHA-256 of shapes and values, the same on every machine."""
    digest = hashlib.sha256()
    for array in arrays:
        plain = np.ascontiguousarray(array)
        little = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{little.dtype.str} {little.shape}\n".encode())
        digest.update(little.tobytes())
    return digest.hexdigest()


def _covariance(residuals: Floats) -> Floats:
    """(2 H, 2 H), about the mean, divided by the number of sequences."""
    flat = residuals.reshape(len(residuals), -1)
    apart = flat - flat.mean(axis=0)
    covariance = apart.T @ apart / len(flat)
    return (covariance + covariance.T) / 2  # equal to the last bit


def _whole_parts(run: NDArray[np.intp], complete: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """``run`` cut where a sequence has no forecast."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], complete[run].astype(int), [0]])))
    return [run[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _nested(values: NDArray[np.floating]) -> tuple:
    """Nested tuples of Python floats."""
    return _tuples(np.asarray(values, dtype=np.float64).tolist())


def _tuples(value: list | float) -> tuple:
    return tuple(_tuples(v) if isinstance(v, list) else v for v in value)  # pyright: ignore
