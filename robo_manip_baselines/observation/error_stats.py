"""Reader of ``error_stats.json``, which ``face_prediction export-stats`` writes.

Legend: H horizons, K lags, n forecasts of a run; the last axis is U, V: right and down in the
image.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.observation.state import Floats
from robo_manip_baselines.runs.errors import RequestError

SCHEMA = "error_stats"
VERSION = 1
DEFAULT_STATS = Path(__file__).with_name("assets") / "error_stats.json"


@dataclass(frozen=True)
class ErrorStats:
    """Statistics of a predictor's errors: forecast minus truth of the mouth centre.

    Attributes:
        predictor: what made the forecasts.
        stride: frames of 1/30 s between one forecast of a clip and the next.
        mean_abs: (H, 2) m, mean absolute errors by equations 6 and 7.
        bias: (H, 2) m, mean errors.
        covariance: (2 H, 2 H) m^2, of one forecast, in the order 1 U, 1 V, 2 U, ...
        autocorrelation: (K, H, 2) with the forecast k strides later.
        runs: (n, H, 2) m each, errors of forecasts made one after another; may be none.
        source: the file.
        sha256: of the file's bytes.
    """

    predictor: str
    stride: int
    mean_abs: Floats
    bias: Floats
    covariance: Floats
    autocorrelation: Floats
    runs: tuple[Floats, ...]
    source: Path
    sha256: str

    @property
    def horizons(self) -> int:
        """H, how many frames ahead there are errors of."""
        return len(self.mean_abs)


def load_error_stats(path: str | Path | None = None, sha256: str | None = None) -> ErrorStats:
    """Read what ``face_prediction export-stats`` wrote.

    Args:
        path: the file; the one that ships with the package if None.
        sha256: what the file's digest must be, if given.

    Raises:
        RequestError: the file is missing, damaged, of another schema or not the wanted one.
    """
    source = DEFAULT_STATS if path is None else Path(path)
    remedy = "make one with 'python -m face_prediction export-stats' or leave error_stats out"
    try:
        content = source.read_bytes()
    except OSError as error:
        reason = f"cannot be read: {error.strerror or error}"
        raise RequestError(f"error statistics '{source}' {reason}; {remedy}") from error
    digest = hashlib.sha256(content).hexdigest()
    if sha256 not in (None, digest):
        raise RequestError(
            f"error statistics '{source}' are not those that were used before (SHA-256 "
            f"{digest[:12]}, not {str(sha256)[:12]}); give the file that was, as error_stats"
        )
    try:
        stored = json.loads(content)
        kind = (stored.get("schema"), stored.get("version")) if isinstance(stored, dict) else None
        if kind != (SCHEMA, VERSION):
            raise ValueError(f"it is not '{SCHEMA}' of version {VERSION}")
        return _from_json(stored, source, digest)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        what = f"'{error.args[0]}' is missing" if isinstance(error, KeyError) else str(error)
        raise RequestError(f"error statistics '{source}' are damaged: {what}; {remedy}") from error


def _from_json(stored: Mapping[str, Any], source: Path, digest: str) -> ErrorStats:
    fps, stride = float(stored["fps"]), int(stored["stride_frames"])
    if fps != 30.0 or stride < 1:
        raise ValueError(f"fps {fps:g} and stride_frames {stride} must be 30 and 1 or more")
    rows = stored["horizons"]
    size = len(rows)
    if size == 0 or [row["frames"] for row in rows] != list(range(1, size + 1)):
        raise ValueError("'horizons' must be 1, 2, ... frames ahead")
    scale = _metres(stored["camera"])
    both = np.tile(scale, size)
    covariance = _array(stored["covariance"], "covariance", (2 * size, 2 * size))
    least = np.linalg.eigvalsh((covariance + covariance.T) / 2)[0]
    if not np.array_equal(covariance, covariance.T) or least < -1e-6 * np.trace(covariance):
        raise ValueError("'covariance' must be symmetric without negative eigenvalues")
    mean_abs = _array([row["mean_abs_m"] for row in rows], "mean_abs_m", (size, 2))
    if (mean_abs < 0).any():
        raise ValueError("'mean_abs_m' must not be negative")
    return ErrorStats(
        predictor=str(stored["predictor"]),
        stride=stride,
        mean_abs=mean_abs,
        bias=_array([row["bias"] for row in rows], "bias", (size, 2)) * scale,
        covariance=covariance * np.outer(both, both),
        autocorrelation=_array(stored["autocorrelation"], "autocorrelation", (None, size, 2)),
        runs=tuple(
            _array(run["values"], f"residuals[{index}]", (None, size, 2)) * scale
            for index, run in enumerate(stored["residuals"])
        ),
        source=source,
        sha256=digest,
    )


def _metres(camera: Mapping[str, Any]) -> Floats:
    """(2,) m that an error of one crop is, right and down: equations 6 and 7 of the paper."""
    keys = ("fov_x_deg", "fov_y_deg", "crop_width", "crop_height", "depth_m")
    given = _array([camera[key] for key in keys], "camera", (5,))
    fov, crop, depth = given[:2], given[2:4], given[4]
    if (given <= 0).any() or (fov >= 180).any():
        raise ValueError("'camera' must have a field of view, a crop and a depth above 0")
    return 2.0 * depth * np.tan(np.radians(fov / 2)) * crop


def _array(values: Any, key: str, shape: tuple[int | None, ...]) -> Floats:
    try:
        array = np.array(values, dtype=np.float64)
    except (ValueError, TypeError):
        raise ValueError(f"'{key}' is no table of numbers") from None
    fits = array.ndim == len(shape) and array.size > 0
    fits = fits and all(want in (None, n) for n, want in zip(array.shape, shape, strict=True))
    if not fits or not np.isfinite(array).all():
        wanted = " x ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"'{key}' must be {wanted} finite numbers")
    return array
