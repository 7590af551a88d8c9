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

from face_prediction.crop_scale import camera_with_crop, crop_spans
from face_prediction.cross_fit import CrossFit, batch_size, cross_fit
from face_prediction.dataset.manifest import SequenceRow
from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError
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
from face_prediction.evaluation.batches import reduction
from face_prediction.predictor import PictureNeeds
from face_prediction.tracks import NUM_LANDMARKS

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
    #: Show a progress bar.
    progress: bool = True


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
    with FaceDataset(options.dataset) as dataset:
        fits = cross_fit(dataset, options.checkpoints, options.baseline)
        found = forecast_all(dataset, fits, options.kind, options.progress)
        clips = [row.clip for row in found.rows]
        span = float(np.median(crop_spans(dataset, sorted(set(clips)))))
        settings = dataset.manifest.settings
    camera = camera_with_crop(given, span, options.crop_width, options.crop_height)
    stats = measure_error_stats(
        mouth_residuals(found.forecasts, found.truth),
        clips,
        [row.subject for row in found.rows],
        [row.start for row in found.rows],
        predictor=fits.name,
        footage=options.kind,
        data_sha256=data_hash(found.truth, found.forecasts),
        stride_frames=settings.stride,
        fps=settings.fps,
        camera=camera,
        keep_runs=options.keep_runs,
    )
    save_error_stats(options.out, stats)
    logger.info("crops span %.3f m at the mouth (median)", span)
    folds = sorted({row.fold for row in found.rows})
    logger.info(
        "%s: %s on %d sequences of kind %s, %d subjects, folds %s",
        options.out,
        stats.predictor,
        stats.sequences,
        stats.footage,
        stats.subjects,
        ", ".join(map(str, folds)),
    )
    print(table(stats))  # noqa: T201
    return 0


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
