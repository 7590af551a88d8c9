"""From errors in the image to errors in metres: equations 6 and 7 of the paper."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.evaluation.errors import Floats, has_forecast, mouth_errors
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

#: What `Camera.metres` computes, as it stands in every file of error statistics.
EQUATIONS = (
    "max_dx = 2 * depth_m * tan(fov_x_deg / 2) * crop_width * dU",
    "max_dy = 2 * depth_m * tan(fov_y_deg / 2) * crop_height * dV",
)


@dataclass(frozen=True)
class Camera:
    """The camera that errors are converted for.

    The paper's equations have dU and dV in whole images. Where they were measured in crops,
    ``crop_width`` and ``crop_height`` say how large the crop is in that camera's image.
    """

    #: degrees, across and up: the webcam of section IV.C
    fov_x_deg: float = 75.0
    fov_y_deg: float = 47.0
    #: metres from the camera to the mouth (section IV.C)
    depth_m: float = 0.5
    #: the crop's side as a share of the image's width and height; 1: the crop is the image
    crop_width: float = 1.0
    crop_height: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            limit = 180.0 if name.startswith("fov") else np.inf
            if not 0 < value < limit:
                raise RequestError(f"camera: {name} {value}; must be above 0 and below {limit}")

    def metres(self, errors: NDArray[np.floating]) -> NDArray[np.float64]:
        """Errors (..., 2) across and up in metres, parallel to the image, of (dU, dV)."""
        half = np.radians([self.fov_x_deg / 2, self.fov_y_deg / 2])
        view = 2 * self.depth_m * np.tan(half)  # width and height of what is seen, at that depth
        return np.asarray(errors) * view * (self.crop_width, self.crop_height)


PAPER_CAMERA = Camera()


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


SCHEMA = "error_stats"
VERSION = 1


def save_error_stats(path: Path, stats: ErrorStats) -> None:
    """Write ``stats`` to ``path``, whole or not at all.

    Raises:
        RequestError: the folder cannot be written.
    """
    text = json.dumps(
        {"schema": SCHEMA, "version": VERSION, **asdict(stats)}, allow_nan=False, indent=1
    )
    # numbers of one innermost list side by side: shorter, and readable. In JSON only the layout
    # has line breaks, so no text is touched.
    text = re.sub(r"\[\n\s*([-+0-9.eE,\s]+?)\n\s*\]", lambda m: f"[{' '.join(m[1].split())}]", text)
    with atomic_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def load_error_stats(path: Path) -> ErrorStats:
    """Read and check ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema or version, or breaks a
            promise of `ErrorStats`; the message names the file and the key.
    """
    if not path.is_file():
        raise RequestError(f"{path}: no such file; expected '{SCHEMA}' as JSON")
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RequestError(f"{path}: damaged or not JSON ({error}); make it again") from None
    found = stored.get("schema") if isinstance(stored, dict) else None
    if found != SCHEMA:
        raise RequestError(f"{path}: schema '{found}', expected '{SCHEMA}'")
    if stored.get("version") != VERSION:
        raise RequestError(
            f"{path}: version {stored.get('version')} of '{SCHEMA}', this program reads {VERSION}; "
            "make the file again"
        )
    try:
        return _from_record(stored)
    except RequestError as error:
        raise RequestError(f"{path}: {error}; make the file again") from None


def _from_record(stored: Mapping[str, Any]) -> ErrorStats:
    values = {key: value for key, value in stored.items() if key not in ("schema", "version")}
    values["camera"] = _build(Camera, stored.get("camera"), "camera")
    for key, kind in (("horizons", HorizonErrors), ("residuals", ResidualRun)):
        items = stored.get(key)
        if not isinstance(items, list):
            raise RequestError(f"'{key}' is missing or is not a list")
        values[key] = [_build(kind, item, f"{key}[{i}]") for i, item in enumerate(items)]
    return _build(ErrorStats, values, "")


def _build(kind: type[Any], record: Any, where: str) -> Any:
    """A dataclass from a mapping with exactly its fields, lists made tuples."""
    if not isinstance(record, Mapping):
        raise RequestError(f"'{where}' is missing or is not an object")
    wanted = kind.__dataclass_fields__
    for key in [*wanted, *record]:
        if key not in record:
            raise RequestError(f"'{where and where + '.'}{key}' is missing")
        if key not in wanted:
            raise RequestError(f"'{where and where + '.'}{key}' is not a key of this schema")
    for key, field in wanted.items():
        if not _fits(record[key], field.type):
            raise RequestError(f"'{where and where + '.'}{key}' is not of type {field.type}")
    return kind(**{key: _as_tuples(record[key]) for key in wanted})


def _fits(value: Any, annotation: str) -> bool:
    """Whether ``value`` is what a field with this annotation stands as in JSON."""
    if annotation.startswith("tuple["):
        inner = annotation.removeprefix("tuple[").removesuffix(", ...]")
        return isinstance(value, list) and all(_fits(item, inner) for item in value)
    if annotation in ("int", "float"):
        kinds = int if annotation == "int" else (int, float)
        return isinstance(value, kinds) and not isinstance(value, bool)
    return annotation != "str" or isinstance(value, str)


def _as_tuples(value: Any) -> Any:
    return tuple(_as_tuples(item) for item in value) if isinstance(value, list) else value


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
