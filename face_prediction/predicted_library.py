"""The clips behind a motion library, and the library with forecasts in it.

Legend: N frames, H horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from face_prediction.attribution import Attribution
from face_prediction.dataset.manifest import Manifest
from face_prediction.errors import RequestError
from face_prediction.library import MotionLibrary, build_library
from face_prediction.motion import ClipMotion, MotionSettings, lift
from face_prediction.motion_command import attribution_of, describe
from face_prediction.predicted_motion import errors_across
from face_prediction.quality import QualityLimits
from face_prediction.tracks import FaceTrack, load_track

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
