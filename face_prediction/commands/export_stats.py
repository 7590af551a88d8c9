"""``face-prediction export-stats``: a predictor's errors, as the robot's side is told of them.

Legend: N sequences, F frames of one, T frames of history, H horizon, L = 468 landmarks.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from face_prediction.dataset.clip_file import reduction
from face_prediction.dataset.manifest import SequenceRow
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation import (
    PAPER_CAMERA,
    Camera,
    ErrorStats,
    data_hash,
    load_error_stats,
    measure_error_stats,
    mouth_residuals,
    save_error_stats,
)
from face_prediction.evaluation.library_errors import (
    camera_with_crop,
    crop_spans,
    library_residuals,
    shortened,
)
from face_prediction.evaluation.setup import CrossFit, batch_size, cross_fit
from face_prediction.motion.library import load_motion
from face_prediction.prediction.interface import PictureNeeds
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ExportStatsOptions:
    """Measure how far forecasts of the mouth are off, on people that the predictor never saw.

    Every fold is forecast by what was fitted without its people: by the checkpoint with that test
    fold, or by a baseline fitted to the other folds.

    Example: face-prediction export-stats --dataset face_dataset --baseline ar_landmarks
    """

    #: Folder made by build-dataset.
    dataset: Path
    #: Folders of trained networks of one kind, each of another test fold. Sequences of folds that
    #: none of them tests are left out.
    checkpoints: tuple[Path, ...] = ()
    #: A forecaster that is fitted here, instead.
    baseline: str | None = None
    #: A motion library with forecasts (face-prediction predict), instead: its forecasts are
    #: measured, one a frame, where the dataset's sequences are ``stride`` frames apart. Clips that
    #: are in the library are in the dataset, which tells their kind and the size of their crops.
    library: Path | None = None
    #: Footage to measure on.
    kind: Literal["natural", "head_motion", "grid"] = "natural"
    #: The file to write.
    out: Path = Path("error_stats.json")
    #: Side of the crop as a share of the camera's image width. By default the median size of
    #: the crops, in metres at the mouth, as the camera below sees it.
    crop_width: float | None = None
    #: The same of the image height.
    crop_height: float | None = None
    #: Degrees across, of the camera that errors are converted to metres for.
    fov_x_deg: float = PAPER_CAMERA.fov_x_deg
    #: Degrees up.
    fov_y_deg: float = PAPER_CAMERA.fov_y_deg
    #: Metres from that camera to the mouth.
    depth_m: float = PAPER_CAMERA.depth_m
    #: Whether the file holds the errors themselves, for error "empirical" of the robot's side.
    keep_runs: bool = True
    #: Forecasts of each clip that the file holds at most; None: all.
    max_run_frames: int | None = None
    #: Show a progress bar.
    progress: bool = True


@dataclass(frozen=True)
class Measured:
    """Signed errors (N, H, 2) in crops, where each is from, and what made the forecasts."""

    residuals: NDArray[np.float64]
    clips: Sequence[str]
    subjects: Sequence[str]
    starts: Sequence[int]
    stride: int
    predictor: str
    data_sha256: str
    #: m that a crop spans at the mouth, the median
    span: float


@dataclass(frozen=True)
class Forecasts:
    """Truth and forecasts (N, H, L, 2) of sequences, in crops, and where each is from."""

    truth: NDArray[np.float32]
    forecasts: NDArray[np.float32]
    rows: tuple[SequenceRow, ...]


def run_export_stats(options: ExportStatsOptions) -> int:
    """Forecast, measure, write.

    Raises:
        RequestError: dataset or predictor cannot be used, or nothing is left to measure.
    """
    given = Camera(options.fov_x_deg, options.fov_y_deg, options.depth_m)
    refuse_other_files(options.out)
    if options.max_run_frames is not None and options.max_run_frames < 1:
        raise RequestError(f"--max_run_frames {options.max_run_frames}: 1 or more")
    with FaceDataset(options.dataset) as dataset:
        found = (
            of_dataset(dataset, options)
            if options.library is None
            else of_library(dataset, options, options.library)
        )
        fps = dataset.manifest.settings.fps
    stats = measure_error_stats(
        found.residuals,
        found.clips,
        found.subjects,
        found.starts,
        predictor=found.predictor,
        footage=options.kind,
        data_sha256=found.data_sha256,
        stride_frames=found.stride,
        fps=fps,
        camera=camera_with_crop(given, found.span, options.crop_width, options.crop_height),
        keep_runs=options.keep_runs,
    )
    if options.max_run_frames is not None:
        stats = shortened(stats, options.max_run_frames)
    save_error_stats(options.out, stats)
    logger.info("crops span %.3f m at the mouth (median)", found.span)
    logger.info(
        "%s: %s on %d forecasts of kind %s, %d subjects",
        options.out,
        stats.predictor,
        stats.sequences,
        stats.footage,
        stats.subjects,
    )
    print(table(stats))  # noqa: T201
    return 0


def of_dataset(dataset: FaceDataset, options: ExportStatsOptions) -> Measured:
    """Forecast the dataset's sequences, and measure.

    Raises:
        RequestError: as `cross_fit` and `forecast_all` do.
    """
    fits = cross_fit(dataset, options.checkpoints, options.baseline)
    found = forecast_all(dataset, fits, options.kind, options.progress)
    clips = [row.clip for row in found.rows]
    return Measured(
        residuals=mouth_residuals(found.forecasts, found.truth),
        clips=clips,
        subjects=[row.subject for row in found.rows],
        starts=[row.start for row in found.rows],
        stride=dataset.manifest.settings.stride,
        predictor=fits.name,
        data_sha256=data_hash(found.truth, found.forecasts),
        span=float(np.median(crop_spans(dataset, sorted(set(clips))))),
    )


def of_library(dataset: FaceDataset, options: ExportStatsOptions, path: Path) -> Measured:
    """Measure the forecasts of a library.

    Raises:
        RequestError: there are others beside, or the library cannot be used.
    """
    if options.checkpoints or options.baseline is not None:
        raise RequestError("--library: holds forecasts; leave --checkpoints and --baseline out")
    library = load_motion(path)
    kinds = {clip.clip: clip.kind for clip in dataset.manifest.clips if clip.sequences}
    strange = sorted(set(library.run_clip.tolist()) - set(kinds))
    if strange:
        raise RequestError(f"--library {path}: {dataset.folder} has no clip '{strange[0]}'")
    found = library_residuals(
        library, {clip for clip, kind in kinds.items() if kind == options.kind}
    )
    span = float(np.median(crop_spans(dataset, sorted(set(found.clips)))))
    return Measured(
        residuals=found.metres / span,
        clips=found.clips,
        subjects=found.subjects,
        starts=found.starts,
        stride=1,
        predictor=str(library.metadata["prediction"]["predictor"]),
        data_sha256=data_hash(found.metres),
        span=span,
    )


def forecast_all(dataset: FaceDataset, fits: CrossFit, kind: str, progress: bool) -> Forecasts:
    """Forecast every sequence of ``kind`` whose fold has a predictor.

    Raises:
        RequestError: there is no such sequence, or a predictor was fitted to somebody in it.
    """
    indices = dataset.indices(folds=set(fits.by_fold), kinds={kind})
    if not len(indices):
        folds = ", ".join(map(str, sorted(fits.by_fold)))
        raise RequestError(f"{dataset.folder}: no sequence of kind '{kind}' in fold {folds}")
    rows = dataset.rows()
    chosen = [rows[i] for i in indices.tolist()]
    folds = np.array([row.fold for row in chosen])
    history, future = dataset.manifest.settings.history, dataset.manifest.settings.future
    truth = np.empty((len(indices), future, NUM_LANDMARKS, 2), dtype=np.float32)
    ahead = np.empty_like(truth)
    with tqdm(total=len(indices), unit="sequence", leave=False, disable=not progress) as bar:
        for fold in sorted(set(folds.tolist())):
            places = np.flatnonzero(folds == fold)
            predictors = [fits.of(fold, chosen[place].subject) for place in places]
            size = batch_size(predictors[0].needs)
            for some in (places[i : i + size] for i in range(0, len(places), size)):
                points = np.stack([dataset.landmarks(i)[..., :2] for i in indices[some].tolist()])
                seen = pictures(dataset, indices[some].tolist(), predictors[0].needs)
                forecast = predictors[0].predict(points[:, :history], seen, future)
                truth[some], ahead[some] = points[:, history:], forecast.landmarks
                bar.update(len(some))
    return Forecasts(truth, ahead, tuple(chosen))


def pictures(
    dataset: FaceDataset, indices: Sequence[int], needs: PictureNeeds
) -> NDArray[np.uint8] | None:
    """The last pictures (B, P, S, S, 3) of the histories of sequences; None where not needed.

    Raises:
        RequestError: the predictor looks at pictures of a size that the dataset cannot give.
    """
    if needs.frames == 0:
        return None
    settings = dataset.manifest.settings
    reduce = reduction(settings.crop_size, needs.size)
    last = slice(settings.history - needs.frames, settings.history)
    return np.stack([dataset.pictures(i, last, reduce) for i in indices])


def refuse_other_files(out: Path) -> None:
    """Check that nothing but an older file of error statistics is lost by writing ``out``.

    Raises:
        RequestError: it is a folder, or a file of another kind.
    """
    if out.is_dir():
        raise RequestError(f"--out {out}: is a folder; name a file")
    if out.exists():
        try:
            load_error_stats(out)
        except RequestError as error:
            raise RequestError(f"{error}; it is in the way of --out, so remove it first") from None


def table(stats: ErrorStats) -> str:
    """Mean absolute errors by frame ahead, as Markdown."""
    lines = ["| frame ahead | dU crop | dV crop | across mm | up mm |", "|---|---|---|---|---|"]
    for horizon in stats.horizons:
        (u, v), (x, y) = horizon.mean_abs, horizon.mean_abs_m
        lines.append(f"| {horizon.frames} | {u:.4f} | {v:.4f} | {1e3 * x:.2f} | {1e3 * y:.2f} |")
    return "\n".join(lines)
