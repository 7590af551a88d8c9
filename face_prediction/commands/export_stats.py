"""``face-prediction export-stats``: a predictor's errors, for the robot's side to draw from.

Legend: N sequences, H horizon.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import open_clip, read_array, read_record
from face_prediction.dataset.image_batches import SequenceBatch
from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.error_stats import (
    PAPER_CAMERA,
    Camera,
    Length,
    MouthResiduals,
    PredictorErrorStats,
    ViewAngle,
    data_hash,
    load_predictor_error_stats,
    measure_error_stats,
    save_predictor_error_stats,
)
from face_prediction.evaluation.predictors import EvaluatedPredictor, batch_size, cross_fit
from face_prediction.evaluation.setup import select_sequences
from face_prediction.motion.library import load_motion
from face_prediction.prediction.errors import mouth_residuals
from face_prediction.tracking.geometry import VERTICAL_FOV_DEGREES
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import FileKind, require_out_file
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.progress import ProgressBar
from robo_manip_baselines.runs.ranges import Count, require_ranges

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ExportStatsOptions:
    """Measure how far forecasts of the mouth are off, on people that the predictor never saw.

    Every fold is forecast by a predictor fitted without its people: by the checkpoint with that
    test fold, or by a baseline fitted to the other folds.

    Example: face-prediction export-stats --dataset face_dataset --baseline ar_landmarks

    Attributes:
        dataset: folder made by build-dataset.
        checkpoints: folders of trained networks of one kind, each of another test fold. Sequences
            of folds that none of them tests are left out.
        baseline: a forecaster that is fitted here, instead.
        library: a motion library with forecasts (face-prediction predict), instead: its forecasts
            are measured, one a frame, where the dataset's sequences are ``stride`` frames apart.
            Clips that are in the library are in the dataset, which gives their kind and the size
            of their crops.
        kind: footage to measure on.
        out: the file to write.
        crop_width: side of the crop as a share of the camera's image width. By default the median
            size of the crops, in metres at the mouth, as the camera below sees it.
        crop_height: the same of the image height.
        fov_x_deg: degrees across, of the camera that errors are converted to metres for.
        fov_y_deg: degrees up.
        depth_m: metres from that camera to the mouth.
        keep_runs: whether the file holds the errors themselves, for error "empirical" of the
            robot's side.
        max_run_frames: forecasts of each clip that the file holds at most; None: all.
        progress: show a progress bar.
    """

    dataset: Path
    checkpoints: tuple[Path, ...] = ()
    baseline: str | None = None
    library: Path | None = None
    kind: Literal["natural", "head_motion", "grid"] = "natural"
    out: Path = Path("error_stats.json")
    crop_width: Length | None = None
    crop_height: Length | None = None
    fov_x_deg: ViewAngle = PAPER_CAMERA.fov_x_deg
    fov_y_deg: ViewAngle = PAPER_CAMERA.fov_y_deg
    depth_m: Length = PAPER_CAMERA.depth_m
    keep_runs: bool = True
    max_run_frames: Count | None = None
    progress: bool = True


def run_export_stats(options: ExportStatsOptions) -> int:
    """Forecast, measure, write.

    Raises:
        RequestError: dataset or predictor cannot be used, or nothing is left to measure.
    """
    camera = Camera(options.fov_x_deg, options.fov_y_deg, options.depth_m)
    inputs = [options.dataset, options.library, *options.checkpoints]
    require_out_file(options.out, FileKind("error statistics", load_predictor_error_stats), inputs)
    require_ranges(options, "--{} {}")
    with FaceDataset(options.dataset) as dataset:
        if options.library is None:
            predictor = cross_fit(dataset, options.checkpoints, options.baseline)
            found = dataset_residuals(dataset, predictor, options.kind, options.progress)
            span = median_crop_span(dataset, found.clips)
        elif options.checkpoints or options.baseline is not None:
            raise RequestError("--library: holds forecasts; leave --checkpoints and --baseline out")
        else:
            found, span = library_residuals(dataset, options.library, options.kind)
        fps = dataset.manifest.settings.fps
    stats = measure_error_stats(
        found,
        options.kind,
        fps=fps,
        camera=camera.with_crop(span, options.crop_width, options.crop_height),
        keep_runs=options.keep_runs,
        max_run_frames=options.max_run_frames,
    )
    save_predictor_error_stats(options.out, stats)
    logger.info("crops span %.3f m at the mouth (median)", span)
    counts = (stats.predictor, stats.sequences, stats.footage, stats.subjects)
    logger.info("%s: %s on %d forecasts of kind %s, %d subjects", options.out, *counts)
    print(error_stats_table(stats))  # noqa: T201
    return 0


def dataset_residuals(
    dataset: FaceDataset, predictor: EvaluatedPredictor, kind: str, progress: bool
) -> MouthResiduals:
    """Errors of forecasts of every sequence of ``kind`` whose fold has a predictor.

    Raises:
        RequestError: there is no such sequence, or a predictor was fitted to somebody in it.
    """
    selection = select_sequences(dataset, set(predictor.by_fold), {kind})
    settings = dataset.manifest.settings
    truth = np.stack([dataset.landmarks(i)[settings.history :, :, :2] for i in selection.indices])
    forecasts = np.empty_like(truth)
    with ProgressBar(len(truth), "sequence", shown=progress, keep=False) as bar:
        for places in selection.batches(min(map(batch_size, predictor.needs))):
            indices = selection.indices[places].tolist()
            batch = SequenceBatch(dataset, indices, predictor.needs)
            forecasts[places] = predictor.forecast(selection.rows_at(places), batch).landmarks
            bar.advance(len(places))
    return MouthResiduals(
        mouth_residuals(forecasts, truth),
        clips=[row.clip for row in selection.rows],
        subjects=[row.subject for row in selection.rows],
        starts=[row.start for row in selection.rows],
        stride_frames=settings.stride,
        predictor=predictor.name,
        data_sha256=data_hash(truth, forecasts),
    )


def library_residuals(dataset: FaceDataset, path: Path, kind: str) -> tuple[MouthResiduals, float]:
    """Errors of every forecast in a library's runs of ``kind`` whose H frames the run holds.

    Returns:
        The errors in crops, and the median span of the crops in metres. ``starts`` count frames
        through each clip's runs, one apart within a run and further between runs.

    Raises:
        RequestError: the library holds no forecasts, or none of this kind, or an unknown clip, or
            is at another rate than the dataset.
    """
    library = load_motion(path)
    record = library.metadata.get("prediction")
    if library.predicted_mouth is None or not isinstance(record, dict):
        raise RequestError("--library: holds no forecasts; make it with face-prediction predict")
    fps = dataset.manifest.settings.fps
    if not math.isclose(library.fps, fps, rel_tol=1e-6):
        raise RequestError(
            f"--library {path}: is at {library.fps:g} frames a second, {dataset.folder} at "
            f"{fps:g}; give the dataset that it was forecast with"
        )
    kinds = {clip.clip: clip.kind for clip in dataset.manifest.clips if clip.sequences}
    horizon = library.predicted_mouth.shape[1]
    metres: list[NDArray[np.float64]] = []
    clips: list[str] = []
    subjects: list[str] = []
    starts: list[int] = []
    for index, clip in enumerate(library.run_clip.tolist()):
        if clip not in kinds:
            raise RequestError(f"--library {path}: {dataset.folder} has no clip '{clip}'")
        part = library.run(index)
        count = part.stop - part.start - horizon
        if kinds[clip] != kind or count < 1:
            continue
        mouth = library.mouth[part].astype(np.float64)
        truth = np.stack([mouth[h : h + count] for h in range(1, horizon + 1)], axis=1)
        apart = library.predicted_mouth[part].astype(np.float64)[:count] - truth
        metres.append(apart[..., :2] * (1.0, -1.0))  # y is up, V is down
        clips += [clip] * count
        subjects += [str(library.run_subject[index])] * count
        starts += range(part.start, part.start + count)
    if not metres:
        raise RequestError(f"--library {path}: has no run of kind '{kind}'")
    values = np.concatenate(metres)
    span = median_crop_span(dataset, clips)
    predictor = str(record.get("predictor", "unknown"))
    found = MouthResiduals(values / span, clips, subjects, starts, 1, predictor, data_hash(values))
    return found, span


def median_crop_span(dataset: FaceDataset, clips: Iterable[str]) -> float:
    """Metres that the crop of a sequence of ``clips`` spans across the view, the median.

    A crop of s pixels, seen with a focal length of f pixels (that of `lifting`, from its vertical
    field of view), spans s / f times the distance of the mouth in the last frame of the history.

    Raises:
        RequestError: a clip's file is damaged.
    """
    spans: list[NDArray[np.float64]] = []
    last = dataset.manifest.settings.history - 1
    for clip in sorted(set(clips)):
        path = dataset.folder / CLIP_FOLDER / f"{clip}.h5"
        with open_clip(path) as file:
            height = read_record(path, file)["image_size"][1]
            side = read_array(path, file, "sequences/crop")[:, 2]
            start = read_array(path, file, "sequences/start")
            mouth = read_array(path, file, "frames/mouth")
        focal = height / 2 / math.tan(math.radians(VERTICAL_FOV_DEGREES / 2))
        spans.append(side / focal * -mouth[start + last, 2])
    return float(np.median(np.concatenate(spans)))


def error_stats_table(stats: PredictorErrorStats) -> str:
    """Mean absolute errors by frame ahead, as Markdown."""
    rows = []
    for horizon in stats.horizons:
        crops = (f"{value:.4f}" for value in horizon.mean_abs)
        millimetres = (f"{1e3 * value:.2f}" for value in horizon.mean_abs_m)
        rows.append((horizon.frames, *crops, *millimetres))
    return markdown_table(["frame ahead", "dU crop", "dV crop", "across mm", "up mm"], rows)
