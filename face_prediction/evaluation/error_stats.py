"""``error_stats.json``: statistics of a predictor's mouth errors, from which errors can be drawn.

Legend: N sequences, H horizons, Q quantile levels, K lags, n forecasts of a run; the last axis
holds U and V, in crops.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from face_prediction.prediction.errors import Floats, has_forecast, mouth_errors
from robo_manip_baselines.runs.documents import Schema, read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import to_json, write_text
from robo_manip_baselines.runs.ranges import Count, NonNegativeInt, require_ranges

SCHEMA = Schema("error_stats", 1)
MAX_BYTES = 64 << 20
"""Size of a file: hours of residuals."""

EQUATIONS = (
    "max_dx = 2 * depth_m * tan(fov_x_deg / 2) * crop_width * dU",
    "max_dy = 2 * depth_m * tan(fov_y_deg / 2) * crop_height * dV",
)
"""Equations 6 and 7 of the paper, as `Camera.metres` computes them and as every file holds them."""
QUANTILE_LEVELS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
MAX_LAG = 10  # strides that the autocorrelation is measured over, where a clip is long enough
_DECIMALS = 6  # of residuals in a run: a millionth of a crop, finer than any detector
_TOLERANCE = 1e-6  # relative agreement asked of numbers that follow from others in the file


ViewAngle = Annotated[float, Interval(gt=0.0, lt=180.0)]
Length = Annotated[float, Interval(gt=0.0, le=1e6)]


@dataclass(frozen=True)
class Camera:
    """The camera that errors are converted to metres for.

    The paper's equations have dU and dV in whole images. Where they were measured in crops,
    ``crop_width`` and ``crop_height`` say how large the crop is in that camera's image.

    Attributes:
        fov_x_deg: degrees across, and ``fov_y_deg`` up: the webcam of section IV.C.
        depth_m: metres from the camera to the mouth (section IV.C).
        crop_width: the crop's side as a share of the image's width; 1: the crop is the image.
        crop_height: the same of the height.
    """

    fov_x_deg: ViewAngle = 75.0
    fov_y_deg: ViewAngle = 47.0
    depth_m: Length = 0.5
    crop_width: Length = 1.0
    crop_height: Length = 1.0

    def __post_init__(self) -> None:
        require_ranges(self, "camera: {} {}")

    def metres(self, errors: NDArray[np.floating]) -> Floats:
        """Errors (..., 2) across and up in metres, parallel to the image, of (dU, dV)."""
        half = np.radians([self.fov_x_deg / 2, self.fov_y_deg / 2])
        view = 2 * self.depth_m * np.tan(half)  # width and height of the view at that depth
        return np.asarray(errors) * view * (self.crop_width, self.crop_height)

    def with_crop(
        self, span: float, width: float | None = None, height: float | None = None
    ) -> Camera:
        """This camera with a crop of ``span`` metres at its depth, as shares of its image.

        ``width`` and ``height``, where given, are those shares instead.
        """
        across, up = replace(self, crop_width=1.0, crop_height=1.0).metres(np.ones(2)).tolist()
        return replace(
            self,
            crop_width=span / across if width is None else width,
            crop_height=span / up if height is None else height,
        )


PAPER_CAMERA = Camera()


@dataclass(frozen=True)
class HorizonErrors:
    """Errors of one forecast frame; pairs are (U, V).

    Attributes:
        frames: ahead, 1 is the next.
        forecasts: number of them, beside the ``missing``.
        mean_abs: mean of the absolute errors.
        var_abs: variance of the absolute errors.
        bias: mean of the signed errors.
        quantiles: (2, Q) of the signed errors at ``quantile_levels``.
        mean_abs_m: equations 6 and 7 of ``mean_abs``: (across, up) in metres.
    """

    frames: Count
    forecasts: NonNegativeInt
    missing: NonNegativeInt
    mean_abs: tuple[float, ...]
    var_abs: tuple[float, ...]
    bias: tuple[float, ...]
    quantiles: tuple[tuple[float, ...], ...]
    mean_abs_m: tuple[float, ...]


@dataclass(frozen=True)
class ResidualRun:
    """Signed errors (n, H, 2) of successive forecasts in one clip, ``stride_frames`` apart."""

    clip: str
    subject: str
    values: tuple[tuple[tuple[float, ...], ...], ...]


@dataclass(frozen=True)
class PredictorErrorStats:
    """Contents of one file.

    Attributes:
        predictor: name.
        footage: kind of footage.
        fps: frames a second of the forecasts.
        stride_frames: frames between one forecast of a clip and the next.
        sequences: number of them, of so many ``subjects``.
        data_sha256: of the truth and the forecasts.
        camera: for which errors are converted to metres.
        equations: of that conversion.
        quantile_levels: Q of them.
        horizons: 1 to H frames ahead.
        covariance: (2 H, 2 H) of the signed errors of one sequence, in the order 1 U, 1 V, 2 U, …
        autocorrelation: (K, H, 2) between forecasts k strides apart in one clip, k = 0 … K - 1.
        residuals: runs to resample; may be none.

    Raises:
        RequestError: a number breaks one of these promises; the message names the key.
    """

    predictor: str
    footage: str
    fps: float
    stride_frames: Count
    sequences: Count
    subjects: Count
    data_sha256: str
    camera: Camera
    equations: tuple[str, ...]
    quantile_levels: tuple[float, ...]
    horizons: tuple[HorizonErrors, ...]
    covariance: tuple[tuple[float, ...], ...]
    autocorrelation: tuple[tuple[tuple[float, ...], ...], ...]
    residuals: tuple[ResidualRun, ...] = ()

    def __post_init__(self) -> None:
        for key, holds, promise in self._promises():
            if not holds:
                raise RequestError(f"'{key}' {promise}")

    def _promises(self) -> Iterator[tuple[str, bool | np.bool_, str]]:
        """Keys, whether their promises hold, and the promises."""
        levels = np.array([0.0, *self.quantile_levels, 1.0])
        is_hash = re.fullmatch("[0-9a-f]{64}", self.data_sha256) is not None
        yield "predictor", bool(self.predictor), "must be named"
        yield "fps", 0 < self.fps < np.inf, "must be positive"
        yield "stride_frames", self.stride_frames >= 1, "must be 1 or more"
        yield "subjects", 1 <= self.subjects <= self.sequences, "must be 1 to 'sequences'"
        yield "data_sha256", is_hash, "must be 64 hexadecimal digits"
        yield "equations", self.equations == EQUATIONS, f"must be {list(EQUATIONS)}"
        yield "quantile_levels", len(levels) > 2, "must not be empty"
        yield "quantile_levels", np.all(np.diff(levels) > 0), "must rise, between 0 and 1"
        size = len(self.horizons)
        frames = [horizon.frames for horizon in self.horizons]
        is_counted = size > 0 and frames == list(range(1, size + 1))
        yield "horizons", is_counted, "must be 1, 2, ... frames"
        for number, horizon in enumerate(self.horizons):
            key = f"horizons[{number}]"
            mean, variance, bias, metres = (
                _finite(getattr(horizon, name), f"{key}.{name}", (2,))
                for name in ("mean_abs", "var_abs", "bias", "mean_abs_m")
            )
            quantiles = _finite(horizon.quantiles, f"{key}.quantiles", (2, len(levels) - 2))
            total = horizon.forecasts + horizon.missing
            is_complete = total == self.sequences and 1 <= horizon.forecasts <= total
            is_converted = np.allclose(self.camera.metres(mean), metres, _TOLERANCE, 0.0)
            is_smaller = np.all(np.abs(bias) <= mean * (1 + _TOLERANCE))
            yield f"{key}.mean_abs", np.all(mean >= 0), "must not be negative"
            yield f"{key}.var_abs", np.all(variance >= 0), "must not be negative"
            yield f"{key}.bias", is_smaller, "must not exceed 'mean_abs'"
            yield f"{key}.mean_abs_m", is_converted, "does not follow from 'mean_abs' and 'camera'"
            yield f"{key}.quantiles", np.all(np.diff(quantiles) >= 0), "must rise"
            promise = "must be 1 or more and with 'missing' make 'sequences'"
            yield f"{key}.forecasts", is_complete, promise
        covariance = _finite(self.covariance, "covariance", (2 * size, 2 * size))
        least = np.linalg.eigvalsh(covariance)[0]
        is_positive = least >= -_TOLERANCE * np.trace(covariance)
        is_covariance = np.array_equal(covariance, covariance.T) and is_positive
        yield "covariance", is_covariance, "must be symmetric without negative eigenvalues"
        _finite(self.autocorrelation, "autocorrelation", (None, size, 2))
        for number, run in enumerate(self.residuals):
            _finite(run.values, f"residuals[{number}]", (None, size, 2))


def save_predictor_error_stats(path: Path, stats: PredictorErrorStats) -> None:
    """Write ``stats`` to ``path``, whole or not at all.

    Raises:
        RequestError: the folder cannot be written.
    """
    write_text(path, compact_json({**SCHEMA.to_json(), **asdict(stats)}))


def load_predictor_error_stats(path: Path) -> PredictorErrorStats:
    """Read and check ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema or version, or breaks a
            promise of `PredictorErrorStats`; the message names the file and the key.
    """
    try:
        return read_json(path, PredictorErrorStats, SCHEMA, limit=MAX_BYTES, complete=True)
    except RequestError as error:
        raise RequestError(f"{error}; make the file again") from None


def compact_json(record: Mapping[str, Any]) -> str:
    """JSON with the numbers of an innermost list side by side: shorter, and readable."""
    text = to_json(record, indent=1)
    # in JSON only the layout has line breaks, so no text is touched
    inner = re.compile(r"\[\n\s*([-+0-9.eE,\snul]+?)\n\s*\]")
    return inner.sub(lambda match: f"[{' '.join(match[1].split())}]", text)


@dataclass(frozen=True)
class MouthResiduals:
    """Signed errors of N forecasts, forecast minus truth of the mouth centre.

    Attributes:
        values: (N, H, 2) in crops; NaN where there is no forecast.
        clips: N names of the clips that sequences come from; ``subjects``: of their people.
        starts: N frame numbers in their clips; sequences of a clip whose starts are
            ``stride_frames`` apart are neighbours, of which the autocorrelation speaks.
        stride_frames: frames between neighbours.
        predictor: name.
        data_sha256: of truth and forecasts (`data_hash`).
    """

    values: Floats
    clips: Sequence[str]
    subjects: Sequence[str]
    starts: Sequence[int]
    stride_frames: int
    predictor: str
    data_sha256: str


def measure_error_stats(
    residuals: MouthResiduals,
    footage: str,
    *,
    fps: float = 30.0,
    camera: Camera = PAPER_CAMERA,
    keep_runs: bool = True,
    max_run_frames: int | None = None,
) -> PredictorErrorStats:
    """Statistics of mouth residuals; see `PredictorErrorStats`.

    Args:
        residuals: measured errors.
        footage: kind of footage.
        fps: rate of the forecasts.
        camera: for which errors are converted to metres.
        keep_runs: hold the residuals themselves, to be resampled.
        max_run_frames: forecasts of each clip that are held at most, its longest runs first: enough
            to draw from; None: all.

    Raises:
        RequestError: lengths differ, or a horizon or the whole has no forecast.
    """
    values, clips, subjects = residuals.values, residuals.clips, residuals.subjects
    known = has_forecast(values)
    if not len(values) == len(clips) == len(subjects) == len(residuals.starts):
        raise RequestError(
            f"{len(values)} residuals, {len(clips)} clips, {len(subjects)} subjects and "
            f"{len(residuals.starts)} starts; as many of each are needed"
        )
    complete = np.asarray(known.all(axis=1))
    if not complete.any():
        raise RequestError(f"{residuals.predictor}: no sequence has a forecast for every horizon")
    errors = mouth_errors(values)
    horizons: list[HorizonErrors] = []
    for h, mean in enumerate(errors.mean):
        there = values[known[:, h], h]
        quantiles = np.quantile(there, QUANTILE_LEVELS, axis=0).T
        parts = (mean, errors.variance[h], there.mean(axis=0), quantiles, camera.metres(mean))
        counts = int(errors.forecasts[h]), int(errors.missing[h])
        horizons.append(HorizonErrors(h + 1, *counts, *map(_as_tuples, parts)))
    runs = neighbours(clips, residuals.starts, residuals.stride_frames)
    flat = values[complete].reshape(complete.sum(), -1)
    apart = flat - flat.mean(axis=0)
    covariance = apart.T @ apart / len(flat)
    kept: list[ResidualRun] = []
    for part in (part for run in runs for part in _whole_parts(run, complete)):
        held = _as_tuples(np.round(values[part], _DECIMALS))
        kept.append(ResidualRun(clips[part[0]], subjects[part[0]], held))
    return PredictorErrorStats(
        predictor=residuals.predictor,
        footage=footage,
        fps=fps,
        stride_frames=residuals.stride_frames,
        sequences=len(values),
        subjects=len(set(subjects)),
        data_sha256=residuals.data_sha256,
        camera=camera,
        equations=EQUATIONS,
        quantile_levels=QUANTILE_LEVELS,
        horizons=tuple(horizons),
        covariance=_as_tuples((covariance + covariance.T) / 2),  # equal to the last bit
        autocorrelation=_as_tuples(autocorrelation(values, runs, MAX_LAG)),
        residuals=_shortened(kept, max_run_frames) if keep_runs else (),
    )


def neighbours(clips: Sequence[str], starts: Sequence[int], stride: int) -> list[NDArray[np.intp]]:
    """Indices of sequences that follow one another in one clip, ``stride`` frames apart.

    Every sequence is in one run; a run may have one.
    """
    order = sorted(range(len(clips)), key=lambda i: (clips[i], starts[i]))
    cuts = [
        place
        for place, (a, b) in enumerate(pairwise(order), start=1)
        if (clips[a], starts[a] + stride) != (clips[b], starts[b])
    ]
    return np.split(np.array(order), cuts)


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
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{little.dtype.str} {little.shape}\n".encode())
        digest.update(little.tobytes())
    return digest.hexdigest()


def _whole_parts(run: NDArray[np.intp], complete: NDArray[np.bool_]) -> list[list[int]]:
    """``run`` cut where a sequence has no forecast."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], complete[run].astype(int), [0]])))
    return [run[a:b].tolist() for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _shortened(runs: Sequence[ResidualRun], frames: int | None) -> tuple[ResidualRun, ...]:
    if frames is None:
        return tuple(runs)
    left = dict.fromkeys((run.clip for run in runs), frames)
    kept: list[ResidualRun] = []
    for run in sorted(runs, key=lambda run: -len(run.values)):
        count = min(len(run.values), left[run.clip])
        if count:
            left[run.clip] -= count
            kept.append(replace(run, values=run.values[:count]))
    return tuple(kept)


def _finite(values: Any, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Nested tuples of numbers as an array of that shape; None: any length."""
    try:
        array = np.array(values, dtype=np.float64)
    except ValueError:
        raise RequestError(f"'{key}' has rows of different lengths") from None
    wanted = ", ".join("n" if length is None else str(length) for length in shape)
    sizes = zip(shape, array.shape, strict=False)
    fits = array.ndim == len(shape) and all(length in (None, found) for length, found in sizes)
    if not (fits and np.all(np.isfinite(array))):
        raise RequestError(f"'{key}' must be finite, of shape ({wanted})")
    return array


def _as_tuples(values: Any) -> Any:
    """Nested tuples of Python floats."""
    if isinstance(values, np.ndarray):
        values = np.asarray(values, dtype=np.float64).tolist()
    return tuple(map(_as_tuples, values)) if isinstance(values, list) else values
