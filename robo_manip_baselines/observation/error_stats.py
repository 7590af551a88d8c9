"""Reader of ``error_stats.json``, which ``face_prediction export-stats`` writes.

Legend: H horizons, K lags, n forecasts of a run; the last axis is U, V: right and down in the
image.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval, Len

from robo_manip_baselines.observation.state import Floats
from robo_manip_baselines.runs.documents import (
    IGNORES_OTHERS,
    Schema,
    convert,
    parse_json_bytes,
    read_bytes,
)
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Amount

SCHEMA = Schema("error_stats", 1)
MAX_BYTES = 64 << 20
"""Size of a file: hours of residuals."""

DEFAULT_STATS = Path(__file__).with_name("assets") / "error_stats.json"


@dataclass(frozen=True)
class ErrorStats:
    """Statistics of a predictor's errors: forecast minus truth of the mouth centre.

    Arrays are read-only, since readers of the same file share them.

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

    def require_horizon(self, horizon: int) -> None:
        """Require statistics that far ahead: they are measured, and errors beyond them unknown.

        Raises:
            RequestError: they do not go that far.
        """
        if horizon > self.horizons:
            raise RequestError(
                f"error statistics '{self.source}' go {self.horizons} frames ahead; choose a "
                f"horizon up to that, not {horizon}, or other statistics"
            )


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
    first = f"error statistics '{source}'"
    try:
        content = read_bytes(source, MAX_BYTES)
    except RequestError as error:
        raise RequestError(f"error statistics: {error}; {remedy}") from error
    digest = hashlib.sha256(content).hexdigest()
    if sha256 not in (None, digest):
        raise RequestError(
            f"{first} are not those that were used before (SHA-256 {digest[:12]}, not "
            f"{str(sha256)[:12]}); give the file that was, as error_stats"
        )
    try:
        return _parsed(content, source, digest)
    except RequestError as error:
        raise RequestError(f"{error}; {remedy}") from error


# Every environment of a batch reads the same file, which takes a third of a second to check.
@lru_cache(maxsize=4)
def _parsed(content: bytes, source: Path, digest: str) -> ErrorStats:
    first = f"error statistics '{source}'"
    rest = SCHEMA.without(parse_json_bytes(content, first, MAX_BYTES), first)
    return _from_document(convert(rest, StoredErrorStats, first), source, digest)


_Pair = tuple[float, float]
_Length = Annotated[float, Interval(gt=0.0, le=1e6)]


@dataclass(frozen=True)
class StoredCamera:
    """Camera that errors are converted to metres for: degrees, m, and shares of its image."""

    __pydantic_config__: ClassVar = IGNORES_OTHERS

    fov_x_deg: Annotated[float, Interval(gt=0.0, lt=180.0)]
    fov_y_deg: Annotated[float, Interval(gt=0.0, lt=180.0)]
    depth_m: _Length
    crop_width: _Length
    crop_height: _Length


@dataclass(frozen=True)
class StoredHorizon:
    """Errors of one forecast frame."""

    __pydantic_config__: ClassVar = IGNORES_OTHERS

    frames: int
    bias: _Pair
    mean_abs_m: tuple[Amount, Amount]


@dataclass(frozen=True)
class StoredRun:
    """(n, H, 2) errors of successive forecasts."""

    __pydantic_config__: ClassVar = IGNORES_OTHERS

    values: Annotated[tuple[tuple[_Pair, ...], ...], Len(1)]


@dataclass(frozen=True)
class StoredErrorStats:
    """Part of ``error_stats.json`` that errors are drawn from; see `ErrorStats`."""

    __pydantic_config__: ClassVar = IGNORES_OTHERS

    predictor: str
    fps: float
    stride_frames: Annotated[int, Interval(ge=1, le=10_000)]
    camera: StoredCamera
    horizons: Annotated[tuple[StoredHorizon, ...], Len(1, 100)]
    covariance: tuple[tuple[float, ...], ...]
    autocorrelation: Annotated[tuple[tuple[_Pair, ...], ...], Len(1)]
    residuals: tuple[StoredRun, ...]

    def __post_init__(self) -> None:
        size = len(self.horizons)
        if self.fps != 30.0:
            raise RequestError(f"fps {self.fps:g}: must be 30")
        if [row.frames for row in self.horizons] != list(range(1, size + 1)):
            raise RequestError("'horizons' must be 1, 2, ... frames ahead")
        if {len(self.covariance), *map(len, self.covariance)} != {2 * size}:
            raise RequestError(f"'covariance' must be {2 * size} x {2 * size} numbers")
        covariance = np.array(self.covariance)
        with np.errstate(over="ignore", invalid="ignore"):
            least = np.linalg.eigvalsh((covariance + covariance.T) / 2)[0]
            is_positive = least >= -1e-6 * np.trace(covariance)
        if not (np.array_equal(covariance, covariance.T) and is_positive):
            raise RequestError("'covariance' must be symmetric without negative eigenvalues")
        tables = {"autocorrelation": self.autocorrelation}
        tables |= {f"residuals[{i}]": run.values for i, run in enumerate(self.residuals)}
        for name, table in tables.items():
            if set(map(len, table)) != {size}:
                raise RequestError(f"'{name}' must be n x {size} x 2 numbers")


def _from_document(stored: StoredErrorStats, source: Path, digest: str) -> ErrorStats:
    scale = _metres(stored.camera)
    both = np.tile(scale, len(stored.horizons))
    stats = ErrorStats(
        predictor=stored.predictor,
        stride=stored.stride_frames,
        mean_abs=np.array([row.mean_abs_m for row in stored.horizons]),
        bias=np.array([row.bias for row in stored.horizons]) * scale,
        covariance=np.array(stored.covariance) * np.outer(both, both),
        autocorrelation=np.array(stored.autocorrelation),
        runs=tuple(np.array(run.values) * scale for run in stored.residuals),
        source=source,
        sha256=digest,
    )
    for shared in (
        stats.mean_abs,
        stats.bias,
        stats.covariance,
        stats.autocorrelation,
        *stats.runs,
    ):
        shared.setflags(write=False)
    return stats


def _metres(camera: StoredCamera) -> Floats:
    """(2,) m that an error of one crop is, right and down: equations 6 and 7 of the paper."""
    fov = np.array([camera.fov_x_deg, camera.fov_y_deg])
    crop = np.array([camera.crop_width, camera.crop_height])
    return 2.0 * camera.depth_m * np.tan(np.radians(fov / 2)) * crop
