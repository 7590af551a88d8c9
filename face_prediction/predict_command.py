"""``face-prediction predict``: a motion library in which every frame also knows its forecast.

Legend: N frames, H horizon, L = 468 landmarks.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from face_prediction.attribution import read_attributions
from face_prediction.cross_fit import batch_size, cross_fit
from face_prediction.dataset.build import ClipSource, require_same_video
from face_prediction.dataset.build_command import find_videos, video_of
from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import ClipFrames, clip_frames
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.errors import RequestError
from face_prediction.history_pictures import history_pictures
from face_prediction.library import load_library, save_library
from face_prediction.motion_command import refuse_other_files, summary, track_files
from face_prediction.predicted_library import (
    LiftedClip,
    errors_by_clip,
    fold_of,
    library_of,
    lift_clips,
)
from face_prediction.predicted_motion import Origin, crop_history, find_origins, forecast_metres
from face_prediction.predictor import Predictor
from face_prediction.video import sha256_of

logger = logging.getLogger(__name__)

#: Frames ahead (paper, IV.A).
HORIZON = 5
WHAT = (
    "predicted_mouth[t, h - 1]: where the mouth was forecast, at frame t, to be at frame t + h; "
    "parallel to the image, at the depth of frame t"
)


@dataclass(frozen=True)
class PredictOptions:
    """Forecast every frame of a motion library, by a predictor that never saw the person.

    Only clips whose row says ship=yes are taken. The dataset says who is in which fold, and how
    crops are laid; a baseline is fitted to it.

    Example: face-prediction predict face_tracks --videos clips --attribution clips.csv
    --dataset face_dataset --baseline ar_landmarks
    """

    #: Folders of tracks, or single tracks, at the dataset's rate.
    tracks: tyro.conf.Positional[tuple[Path, ...]]
    #: Table (.csv, or Markdown) with the columns clip, subject, ship (yes or no), licence, source.
    attribution: Path
    #: Folder made by build-dataset, with the people of the tracks in its folds.
    dataset: Path
    #: Folders that hold the videos; only for a predictor that looks at pictures.
    videos: tuple[Path, ...] = ()
    #: Folders of trained networks of one kind, each of another test fold.
    checkpoints: tuple[Path, ...] = ()
    #: A forecaster that is fitted here, instead.
    baseline: str | None = None
    #: The library to put forecasts into, made by export-motion from the same tracks. By default
    #: one is made here, as export-motion does without further options.
    library: Path | None = None
    #: The library to write.
    out: Path = Path("face_motion_predicted.npz")
    #: Show a progress bar for every clip.
    progress: bool = True


def run_predict(options: PredictOptions) -> int:
    """Forecast every frame of every run, and write the library.

    Raises:
        RequestError: a file cannot be used, they do not belong together, or somebody in the
            library cannot be forecast by what never saw them.
    """
    refuse_other_files(options.out)
    given = None if options.library is None else load_library(options.library)
    rows = read_attributions(options.attribution)
    videos = find_videos(options.videos)
    with FaceDataset(options.dataset) as dataset:
        manifest = dataset.manifest
        fits = cross_fit(dataset, options.checkpoints, options.baseline)
    lifted, withheld = lift_clips(track_files(options.tracks), rows, options.attribution, given)
    clips = [clip for clip in lifted if clip.motion.runs]
    folds = {clip.name: fold_of(clip, manifest) for clip in clips}
    predictors = {clip.name: fits.of(folds[clip.name], clip.row.subject) for clip in clips}
    library = library_of(lifted, withheld, given)
    sources = {
        name: video_for(clip, videos)
        for name, clip in zip(folds, clips, strict=True)
        if predictors[name].needs.frames
    }
    parts: list[NDArray[np.float64]] = []
    short: dict[str, int] = {}
    for clip in clips:
        frames = clip_frames(clip.track, manifest.settings)
        origins = origins_of(clip, frames, manifest.settings)
        short[clip.name] = sum(origin.is_short for origin in origins)
        predictor, video = predictors[clip.name], sources.get(clip.name)
        parts.append(
            forecast_clip(
                clip, frames, origins, predictor, manifest.settings, video, options.progress
            )
        )
    library = replace(library, predicted_mouth=np.concatenate(parts).astype(np.float32))
    errors = errors_by_clip(library)
    record = {
        "what": WHAT,
        "predictor": fits.name,
        "history": manifest.settings.history,
        "dataset_sha256": sha256_of(options.dataset / MANIFEST_NAME),
        "checkpoint_sha256": {
            str(fold): sha256_of(fitted.folder / "model.safetensors")
            for fold, fitted in sorted(fits.by_fold.items())
            if fitted.folder is not None
        },
        "test_fold": folds,
        "frames_with_short_history": short,
        "mean_error_across_mm": errors,
    }
    library = replace(library, metadata={**library.metadata, "prediction": record})
    save_library(options.out, library)
    logger.info("%s: %s, forecast by %s", options.out, summary(library), fits.name)
    print(table(errors, fits.name))  # noqa: T201
    return 0


def origins_of(clip: LiftedClip, frames: ClipFrames, settings: SequenceSettings) -> list[Origin]:
    """What every frame of a clip's runs is forecast from.

    Raises:
        RequestError: the track is at another rate than the dataset.
    """
    if len(frames) != len(clip.track):
        raise RequestError(
            f"{clip.path}: is at {clip.track.fps:g} frames a second, the dataset at "
            f"{settings.fps:g}; extract it with --fps {settings.fps:g}"
        )
    return find_origins(
        clip.run_frames,
        frames.landmarks,
        frames.image_size,
        clip.motion.quality,
        settings.history,
        settings.margin,
    )


def video_for(clip: LiftedClip, videos: dict[str, list[Path]]) -> Path:
    """The video of a clip.

    Raises:
        RequestError: it is in no folder, or is not the one that the track was made from.
    """
    video = video_of(clip.path, videos)
    require_same_video(ClipSource(clip.name, clip.path, video), clip.track, sha256_of(video))
    return video


def forecast_clip(
    clip: LiftedClip,
    frames: ClipFrames,
    origins: Sequence[Origin],
    predictor: Predictor,
    settings: SequenceSettings,
    video: Path | None,
    progress: bool,
) -> NDArray[np.float64]:
    """Mouth positions (N, H, 3) in metres, forecast from every origin of one clip.

    Raises:
        RequestError: the video cannot be used.
    """
    size = batch_size(predictor.needs)
    result: list[NDArray[np.float64]] = []
    cut: Iterator[NDArray[np.uint8]] | None = None
    if video is not None:
        cut = history_pictures(
            video, clip.track, frames.source_frame, origins, predictor.needs, settings
        )
    with tqdm(
        total=len(origins), desc=clip.name, unit="frame", leave=False, disable=not progress
    ) as bar:
        for first in range(0, len(origins), size):
            some = origins[first : first + size]
            seen = [crop_history(o, frames.landmarks, frames.image_size) for o in some]
            pictures = None if cut is None else np.stack([next(cut) for _ in some])
            forecast = predictor.predict(np.stack(seen), pictures, HORIZON)
            result.append(
                forecast_metres(
                    some, forecast.landmarks, frames.landmarks, clip.motion.mouth, frames.image_size
                )
            )
            bar.update(len(some))
    ahead = np.concatenate(result)
    if not np.isfinite(ahead).all():
        raise RequestError(
            f"{predictor.name}: has no forecast for some frames of '{clip.name}'; a library needs "
            "one for each"
        )
    return ahead


def table(errors: dict[str, dict[str, list[float]]], name: str) -> str:
    """The errors as Markdown."""
    count = len(next(iter(errors.values()))["forecast"])
    lines = [
        f"Mean distance across the view in mm by frame ahead: {name} / persistence",
        "",
        "| clip | " + " | ".join(str(h + 1) for h in range(count)) + " |",
        "|---|" + "---|" * count,
    ]
    for clip, row in errors.items():
        pairs = zip(row["forecast"], row["persistence"], strict=True)
        lines.append(f"| {clip} | " + " | ".join(f"{a:.2f} / {b:.2f}" for a, b in pairs) + " |")
    return "\n".join(lines)
