"""The clips behind a motion library, and the library with forecasts in it.

Legend: N frames, H horizon.
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

from face_prediction.commands.build_dataset import find_videos, video_of
from face_prediction.commands.export_motion import (
    attribution_of,
    describe,
    refuse_other_files,
    summary,
    track_files,
)
from face_prediction.dataset.build import ClipSource, require_same_video
from face_prediction.dataset.history_images import history_pictures
from face_prediction.dataset.manifest import MANIFEST_NAME, Manifest
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import ClipFrames, clip_frames
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.evaluation.predictors import batch_size, cross_fit
from face_prediction.motion.library import (
    Attribution,
    MotionLibrary,
    build_library,
    load_library,
    read_attributions,
    save_library,
)
from face_prediction.motion.motion import ClipMotion, MotionSettings, QualityLimits, lift
from face_prediction.prediction.interface import Predictor
from face_prediction.prediction.predicted_motion import (
    Origin,
    crop_history,
    errors_across,
    find_origins,
    forecast_metres,
)
from face_prediction.tracking.tracks import FaceTrack, load_track
from face_prediction.tracking.video import sha256_of
from robo_manip_baselines.runs.errors import RequestError

#: m: two liftings of one track agree to this; a library holds float32.
_SAME_PLACE = 1e-5


@dataclass(frozen=True)
class LiftedClip:
    """One clip of the library."""

    path: Path
    row: Attribution
    track: FaceTrack
    motion: ClipMotion

    @property
    def name(self) -> str:
        """Of the clip."""
        return self.row.clip

    @property
    def run_frames(self) -> list[int]:
        """Frames of all its runs, one run after another."""
        return [frame for run in self.motion.runs for frame in range(*run)]


def lift_clips(
    paths: Sequence[Path],
    rows: dict[str, Attribution],
    table: Path,
    given: MotionLibrary | None,
) -> tuple[list[LiftedClip], int]:
    """The clips that may ship (of a given library: its own), and how many may not.

    Raises:
        RequestError: a track has no row or cannot be used, or one of the library's is missing.
    """
    settings = MotionSettings() if given is None else settings_of(given)
    clips: list[LiftedClip] = []
    withheld = 0
    for path in paths:
        row = attribution_of(path, rows, table)
        if not row.ship:
            withheld += 1
        elif given is None or row.clip in given.run_clip:
            track = load_track(path)
            clips.append(LiftedClip(path, row, track, lift(track, settings)))
    if given is not None:
        missing = sorted(set(given.run_clip.tolist()) - {clip.name for clip in clips})
        if missing:
            raise RequestError(
                f"--library: no track with ship=yes of its clips {', '.join(missing)}; give them"
            )
    return clips, withheld


def settings_of(library: MotionLibrary) -> MotionSettings:
    """The settings that a library was made with.

    Raises:
        RequestError: it does not say.
    """
    try:
        stored = dict(library.metadata["settings"])
        limits = QualityLimits(**stored.pop("limits"))
        return MotionSettings(limits=limits, **stored)
    except (KeyError, TypeError, ValueError) as error:
        raise RequestError(
            f"--library: its metadata hold no settings of export-motion ({error}); make it again"
        ) from None


def library_of(
    clips: Sequence[LiftedClip], withheld: int, given: MotionLibrary | None
) -> MotionLibrary:
    """The library of these clips; a given one if it is the same.

    Raises:
        RequestError: there is no run, or the given library was made from other tracks.
    """
    motions = [(clip.name, clip.row, clip.motion) for clip in clips]
    settings = MotionSettings() if given is None else settings_of(given)
    metadata = describe(motions, settings, [dict(c.track.detector) for c in clips], withheld)
    made = build_library([(name, row.subject, motion) for name, row, motion in motions], metadata)
    if given is None:
        return made
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
    return given


def fold_of(clip: LiftedClip, manifest: Manifest) -> int | None:
    """The fold of the person in a clip; None: the person is in none.

    Raises:
        RequestError: the dataset knows the same video under another name.
    """
    video = clip.track.source.get("sha256")
    for entry in manifest.clips:
        if entry.video_sha256 == video and entry.subject != clip.row.subject:
            raise RequestError(
                f"{clip.path}: is of '{clip.row.subject}' in --attribution and of "
                f"'{entry.subject}' in the dataset; use one name for one person"
            )
    return {entry.subject: entry.fold for entry in manifest.clips}.get(clip.row.subject)


def errors_by_clip(library: MotionLibrary) -> dict[str, dict[str, list[float]]]:
    """Mean distance across the view in mm by frame ahead, of the forecasts and of persistence."""
    assert library.predicted_mouth is not None
    pooled: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for index, name in enumerate(library.run_clip.tolist()):
        part = library.run(index)
        mouth = library.mouth[part].astype(np.float64)
        ahead = library.predicted_mouth[part].astype(np.float64)
        still = np.repeat(mouth[:, None], ahead.shape[1], axis=1)
        pooled.setdefault(name, []).append(
            (errors_across(ahead, mouth), errors_across(still, mouth))
        )
    pooled["all"] = [pair for pairs in pooled.values() for pair in pairs]
    result: dict[str, dict[str, list[float]]] = {}
    for name, pairs in pooled.items():
        ours, still = (
            np.nanmean(np.concatenate(side), axis=0) for side in zip(*pairs, strict=True)
        )
        result[name] = {
            "forecast": [round(1e3 * float(value), 4) for value in ours],
            "persistence": [round(1e3 * float(value), 4) for value in still],
        }
    return result


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
    predictors = {
        clip.name: fits.predictor_for(folds[clip.name], clip.row.subject) for clip in clips
    }
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
