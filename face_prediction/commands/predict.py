"""``face-prediction predict``: a library of recorded motion with forecasts of every frame.

Legend: N frames, H horizon.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from annotated_types import Interval
from numpy.typing import NDArray

from face_prediction.dataset.build import find_videos, source_video
from face_prediction.dataset.histories import (
    crop_history,
    errors_across,
    find_origins,
    forecast_metres,
    history_images,
    mouth_ahead,
)
from face_prediction.dataset.manifest import MANIFEST_NAME, Manifest
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import ClipFrames, SequenceSettings, clip_frames
from face_prediction.dataset.tracks import pixel_landmarks
from face_prediction.evaluation.predictors import batch_size, cross_fit, require_strangers
from face_prediction.forecast.interface import mouth_centre
from face_prediction.motion.library import (
    MOTION_LIBRARY,
    LiftedClip,
    RecordedMotion,
    lift_clips,
    load_motion,
    record_motion,
    save_motion,
)
from face_prediction.motion.motion import MotionSettings
from face_prediction.prediction.interface import Predictor, StatefulPredictor
from face_prediction.tracking.tracks import load_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest, locked_file, require_out_file
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.progress import ProgressBar
from robo_manip_baselines.runs.ranges import require_ranges

logger = logging.getLogger(__name__)

HORIZON = 24
"""Frames ahead at most: 0.8 s, as far as the robot's side looks."""
_SAME_PLACE = 1e-4  # m: two extractions of one video agree to this on different processors


@dataclass(frozen=True)
class PredictOptions:
    """Forecast every frame of a motion library, by a predictor that never saw the person.

    Only clips whose row says ship=yes are taken. The dataset gives the folds of the people and the
    settings of crops; a baseline is fitted to it.

    Example: face-prediction predict face_tracks --videos clips --attribution clips.csv
    --dataset face_dataset --baseline ar_landmarks

    Attributes:
        tracks: Folders of tracks, or single tracks, at the dataset's rate.
        attribution: Table (.csv, or Markdown) with the columns clip, subject, ship (yes or no),
            licence, source.
        dataset: Folder made by build-dataset, with the people of the tracks in its folds.
        videos: Folders that hold the videos; only for a predictor that needs images.
        checkpoints: Folders of weights of one kind, each of another test fold; or weights that were
            trained on nobody of the dataset, such as shipped.
        baseline: A forecaster that is fitted here, instead.
        library: The library to put forecasts into, made by export-motion from the same tracks. By
            default one is made here, as export-motion does without further options.
        horizon: Frames ahead to forecast; networks have a longest one.
        out: The library to write.
        progress: Show a progress bar for every clip.
    """

    tracks: tyro.conf.Positional[tuple[Path, ...]]
    attribution: Path
    dataset: Path
    videos: tuple[Path, ...] = ()
    checkpoints: tuple[Path, ...] = ()
    baseline: str | None = None
    library: Path | None = None
    horizon: Annotated[int, Interval(ge=1, le=HORIZON)] = HORIZON
    out: Path = Path("face_motion_predicted.npz")
    progress: bool = True


def run_predict(options: PredictOptions) -> int:
    """Forecast every frame of every run, and write the library.

    Raises:
        RequestError: a file cannot be used, they do not belong together, or somebody in the
            library cannot be forecast by a predictor that never saw the person.
    """
    require_ranges(options, "--{} {}")
    inputs = [*options.tracks, options.attribution, options.dataset, *options.checkpoints]
    require_out_file(options.out, MOTION_LIBRARY, [*inputs, options.library])
    with locked_file(options.out):
        return _predict(options)


def _predict(options: PredictOptions) -> int:
    given = None if options.library is None else load_motion(options.library)
    motion_settings = MotionSettings() if given is None else given.settings()
    videos = find_videos(options.videos)
    with FaceDataset(options.dataset) as dataset:
        manifest = dataset.manifest
        fits = cross_fit(dataset, options.checkpoints, options.baseline)
        for fitted in fits.by_fold.values():
            if fitted.checkpoint is not None and fitted.checkpoint["test_fold"] is None:
                require_strangers(dataset, fitted)
    only = None if given is None else set(given.run_clip.tolist())
    lifted, withheld = lift_clips(options.tracks, options.attribution, motion_settings, only)
    clips = [clip for clip in lifted if clip.motion.runs]
    folds = {clip.row.clip: fold_of(clip, manifest) for clip in clips}
    predictors = [fits.predictor_for(folds[clip.row.clip], clip.row.subject) for clip in clips]
    if given is None:
        library = record_motion(lifted, motion_settings, withheld)
    else:
        require_same_motion(given, lifted, motion_settings)
        library = given
    forecasts: list[NDArray[np.float64]] = []
    short: dict[str, int] = {}
    # the videos are checked before the first is forecast, which may take an hour
    paths: list[Path | None] = [None] * len(clips)
    for i, (clip, predictor) in enumerate(zip(clips, predictors, strict=True)):
        if predictor.needs.frames:
            paths[i], _ = source_video(clip.path, load_track(clip.path), videos)
    settings = manifest.settings
    horizon = min([options.horizon, *(longest_horizon(predictor) for predictor in predictors)])
    for clip, predictor, video in zip(clips, predictors, paths, strict=True):
        found = forecast_clip(clip, predictor, settings, horizon, video, options.progress)
        forecasts.append(found[0])
        short[clip.row.clip] = found[1]
    library = replace(library, predicted_mouth=np.concatenate(forecasts).astype(np.float32))
    errors = errors_by_clip(library)
    record = {
        "what": "predicted_mouth[t, h - 1]: where the mouth was forecast, at frame t, to be at "
        "frame t + h; parallel to the image, at the depth of frame t",
        "predictor": fits.name,
        "history": settings.history,
        "dataset_sha256": file_digest(options.dataset / MANIFEST_NAME),
        "checkpoint_sha256": {
            str(fold): file_digest(fitted.folder / "model.safetensors")
            for fold, fitted in sorted(fits.by_fold.items())
            if fitted.folder is not None
        },
        "test_fold": folds,
        "frames_with_short_history": short,
        "mean_error_across_mm": errors,
    }
    library = replace(library, metadata={**library.metadata, "prediction": record})
    save_motion(options.out, library)
    logger.info("%s: %s, forecast by %s", options.out, library.summary(), fits.name)
    print(error_table(errors, fits.name))  # noqa: T201
    return 0


def require_same_motion(
    given: RecordedMotion, clips: Sequence[LiftedClip], settings: MotionSettings
) -> None:
    """Raise RequestError if a clip of a library is missing, or it was made from other tracks."""
    if given.blended is not None:
        raise RequestError(
            "--library: has spliced runs, of which there is no track; make it without --splice"
        )
    missing = sorted(set(given.run_clip.tolist()) - {clip.row.clip for clip in clips})
    if missing:
        clip_names = ", ".join(missing)
        raise RequestError(
            f"--library: no track with ship=yes of its clips {clip_names}; give them"
        )
    made = record_motion(clips, settings, 0)
    for key in ("run_clip", "run_subject", "run_length", "mouth"):
        ours, theirs = getattr(made, key), getattr(given, key)
        same = ours.shape == theirs.shape and (
            np.allclose(ours, theirs, rtol=0.0, atol=_SAME_PLACE)
            if key == "mouth"
            else np.array_equal(ours, theirs)
        )
        if not same:
            raise RequestError(
                f"--library: its '{key}' is not what these tracks give; name the tracks that it "
                "was made from, or leave --library out"
            )


def fold_of(clip: LiftedClip, manifest: Manifest) -> int | None:
    """Fold of the person in a clip; None: the person is in none.

    Raises:
        RequestError: the dataset has the same video under another subject.
    """
    for entry in manifest.clips:
        if entry.video_sha256 == clip.video_sha256 and entry.subject != clip.row.subject:
            raise RequestError(
                f"{clip.path}: is of '{clip.row.subject}' in --attribution and of "
                f"'{entry.subject}' in the dataset; use one name for one person"
            )
    return {entry.subject: entry.fold for entry in manifest.clips}.get(clip.row.subject)


def forecast_clip(
    clip: LiftedClip,
    predictor: Predictor,
    settings: SequenceSettings,
    horizon: int,
    video: Path | None,
    progress: bool,
) -> tuple[NDArray[np.float64], int]:
    """Mouth positions (N, H, 3) in metres, forecast from every frame of a clip's runs.

    A predictor that keeps a state follows the face from where the stretch begins that a run is in.

    Returns:
        The positions, and how many frames had a history shorter than the dataset's.

    Raises:
        RequestError: the track is at another rate than the dataset, the video cannot be used, or
            a forecast is missing.
    """
    track = load_track(clip.path)
    frames = clip_frames(track, settings)
    if len(frames) != len(track):
        raise RequestError(
            f"{clip.path}: is at {track.fps:g} frames a second, the dataset at "
            f"{settings.fps:g}; extract it with --fps {settings.fps:g}"
        )
    landmarks, image_size = frames.landmarks, frames.image_size
    wanted = [frame for run in clip.motion.runs for frame in range(*run)]
    origins = find_origins(
        wanted, landmarks, image_size, clip.motion.quality, settings.history, settings.margin
    )
    short = sum(origin.is_short for origin in origins)
    if isinstance(predictor, StatefulPredictor):
        ahead = follow_clip(clip, predictor, frames, wanted, horizon)
        return _required(ahead, predictor, clip), short
    images = None
    if video is not None:
        images = history_images(
            video, track, frames.source_frame, origins, predictor.needs, settings
        )
    size = batch_size(predictor.needs)
    result: list[NDArray[np.float64]] = []
    label = clip.row.clip
    with ProgressBar(len(origins), "frame", label, shown=progress, keep=False) as bar:
        for first in range(0, len(origins), size):
            some = origins[first : first + size]
            histories = np.stack([crop_history(o, landmarks, image_size) for o in some])
            shown = None if images is None else np.stack([next(images) for _ in some])
            forecast = predictor.predict(histories, shown, horizon)
            mouth = clip.motion.mouth
            result.append(forecast_metres(some, forecast.landmarks, landmarks, mouth, image_size))
            bar.advance(len(some))
    return _required(np.concatenate(result), predictor, clip), short


def _required(
    ahead: NDArray[np.float64], predictor: Predictor, clip: LiftedClip
) -> NDArray[np.float64]:
    """Raise RequestError unless there is a forecast for every frame."""
    if not np.isfinite(ahead).all():
        raise RequestError(
            f"{predictor.name}: has no forecast for some frames of '{clip.row.clip}'; a library "
            "needs one for each"
        )
    return ahead


def follow_clip(
    clip: LiftedClip,
    predictor: StatefulPredictor,
    frames: ClipFrames,
    wanted: Sequence[int],
    horizon: int,
) -> NDArray[np.float64]:
    """Mouth positions (N, H, 3) m from the ``wanted`` frames (N,), each stretch in one pass."""
    points = np.full((len(frames), horizon, 2), np.nan)  # the mouth ahead, image coordinates
    size = np.array(frames.image_size)
    centre = np.full((len(frames), 2), np.nan)
    for start, stop in clip.motion.quality.segments():
        pixels = pixel_landmarks(frames.landmarks[start:stop], frames.image_size)
        centre[start:stop] = mouth_centre(frames.landmarks[start:stop])
        moved = predictor.forecast_tracks([pixels], horizon)[0].mouth
        points[start:stop] = centre[start:stop, None] + moved / size
    chosen = list(wanted)
    mouth = clip.motion.mouth[chosen]
    return mouth_ahead(mouth, centre[chosen], points[chosen], frames.image_size)


def longest_horizon(predictor: Predictor) -> int:
    """Frames that a predictor forecasts at most."""
    return int(getattr(predictor, "horizon", HORIZON))


Means = list[float | None]


def errors_by_clip(library: RecordedMotion) -> dict[str, dict[str, Means]]:
    """Mean distance across the view in mm by frame ahead, of the forecasts and of persistence.

    None where no run of a clip lasts so many frames.
    """
    assert library.predicted_mouth is not None
    pooled: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for index, name in enumerate(library.run_clip.tolist()):
        part = library.run(index)
        mouth = library.mouth[part].astype(np.float64)
        ahead = library.predicted_mouth[part].astype(np.float64)
        still = np.repeat(mouth[:, None], ahead.shape[1], axis=1)
        pair = (errors_across(ahead, mouth), errors_across(still, mouth))
        pooled.setdefault(name, []).append(pair)
    pooled["all"] = [pair for pairs in pooled.values() for pair in pairs]
    result: dict[str, dict[str, Means]] = {}
    for name, pairs in pooled.items():
        for side, errors in zip(("forecast", "persistence"), zip(*pairs, strict=True), strict=True):
            joined = np.concatenate(errors)
            known = np.isfinite(joined).any(axis=0)
            means = [round(1e3 * float(value), 4) for value in np.nanmean(joined[:, known], axis=0)]
            # errors of a run are known up to a horizon, and of none beyond
            result.setdefault(name, {})[side] = [*means, *[None] * int((~known).sum())]
    return result


def error_table(errors: dict[str, dict[str, Means]], name: str) -> str:
    """The errors as Markdown."""

    def shown(pair: tuple[float | None, ...]) -> str:
        return " / ".join("–" if value is None else f"{value:.2f}" for value in pair)

    count = len(errors["all"]["forecast"])
    rows = [[clip, *map(shown, zip(*row.values(), strict=True))] for clip, row in errors.items()]
    title = f"Mean distance across the view in mm by frame ahead: {name} / persistence"
    return "\n".join([title, "", markdown_table(["clip", *map(str, range(1, count + 1))], rows)])
