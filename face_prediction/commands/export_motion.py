"""``face-prediction export-motion``: face tracks in, one recorded-motion library out."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from face_prediction.motion.library import (
    SCHEMA,
    VERSION,
    Attribution,
    MotionLibrary,
    build_library,
    read_attributions,
    save_library,
)
from face_prediction.motion.motion import ClipMotion, MotionSettings, QualityLimits, lift
from face_prediction.motion.report import clip_row, read_page, write_report
from face_prediction.tracking.lifting import VERTICAL_FOV_DEGREES
from face_prediction.tracking.tracks import load_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import read_npz

logger = logging.getLogger(__name__)

CAMERA_MODEL = (
    f"pinhole, {VERTICAL_FOV_DEGREES:g} degrees vertical field of view (assumed), principal point "
    "in the middle of the image, square pixels; origin at the camera, x right in the image, y up, "
    "z toward the camera; scale from MediaPipe's canonical face"
)
HEAD_POSE = (
    "MediaPipe's fit of its canonical face, to the 25 of its 33 landmarks that do not move with "
    "the mouth (brow, eyes, temples, nose)"
)
MOUTH_MODEL = (
    "mean of the 40 lip landmarks, each on its image ray where that meets the plane through the "
    "canonical mouth centre, normal to the head's z axis"
)


@dataclass(frozen=True)
class ExportMotionOptions:
    """Lift face tracks to metres, cut out what cannot be trusted, and write the runs.

    Only clips whose row says ship=yes are taken. Without --attribution every clip is taken, each
    as a subject of its own, and the library says that nothing is known of its licence.

    Example: face-prediction export-motion face_tracks --attribution clips.csv --out motion.npz
    """

    #: Folders of tracks, or single tracks.
    tracks: tyro.conf.Positional[tuple[Path, ...]]
    #: The library to write.
    out: Path = Path("face_motion.npz")
    #: Table (.csv, or Markdown) with the columns clip, subject, ship (yes or no), licence, source.
    attribution: Path | None = None
    #: Markdown page to put tables and plots into, between its marks; made if absent.
    report: Path | None = None
    #: Seconds of an episode: runs are at least this long, and from every start that leaves this
    #: much, the mouth stays within reach.
    min_run: float = MotionSettings.min_run
    #: Reach in metres on each axis from where a window starts.
    max_displacement: float = MotionSettings.max_displacement
    #: Degrees between the head and facing the camera.
    max_rotation: float = QualityLimits.max_rotation
    #: m/s across the view; a faster mouth is a jump of the detector.
    max_speed: float = QualityLimits.max_speed
    #: m/s^2 across the view; more is a spike.
    max_acceleration: float = QualityLimits.max_acceleration
    #: degrees/s; a faster head is a jump.
    max_turn_rate: float = QualityLimits.max_turn_rate
    #: m/s between the lips; more is a jump.
    max_jaw_speed: float = QualityLimits.max_jaw_speed
    #: Hz of the low-pass on the depth of clips that need it; None: replay every depth as measured.
    depth_cutoff: float | None = MotionSettings.depth_cutoff
    #: Metres: clips whose depth trembles more than this from frame to frame get the low-pass.
    max_depth_tremor: float = MotionSettings.max_depth_tremor


def run_export_motion(options: ExportMotionOptions) -> int:
    """Write the library and, if asked, its report.

    Raises:
        RequestError: a track or the table cannot be used, or no run is left.
    """
    settings = MotionSettings(
        limits=QualityLimits(
            max_speed=options.max_speed,
            max_acceleration=options.max_acceleration,
            max_turn_rate=options.max_turn_rate,
            max_jaw_speed=options.max_jaw_speed,
            max_rotation=options.max_rotation,
        ),
        min_run=options.min_run,
        max_displacement=options.max_displacement,
        depth_cutoff=options.depth_cutoff,
        max_depth_tremor=options.max_depth_tremor,
    )
    refuse_other_files(options.out)
    if options.report is not None:
        read_page(options.report)  # refused now rather than when all is done
    paths = track_files(options.tracks)
    rows = None if options.attribution is None else read_attributions(options.attribution)
    clips: list[tuple[str, Attribution, ClipMotion]] = []
    detectors: list[dict[str, Any]] = []
    withheld = 0
    for path in paths:
        attribution = attribution_of(path, rows, options.attribution)
        if not attribution.ship:
            withheld += 1
            continue
        track = load_track(path)
        clips.append((attribution.clip, attribution, lift(track, settings)))
        detectors.append(dict(track.detector))
    metadata = describe(clips, settings, detectors, withheld)
    library = build_library([(name, row.subject, motion) for name, row, motion in clips], metadata)
    save_library(options.out, library)
    logger.info("%s: %s", options.out, summary(library))
    if options.report is not None:
        write_report(options.report, library, [(name, motion) for name, _, motion in clips])
        logger.info("report in %s", options.report)
    return 0


def track_files(given: Iterable[Path]) -> list[Path]:
    """The track files named, or in the folders named.

    Raises:
        RequestError: a path does not exist, a folder holds no track, or two share a clip's name.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            inside = sorted(path.glob("*.npz"))
            if not inside:
                raise RequestError(f"{path}: no .npz file in it; make tracks with extract")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise RequestError(f"{path}: no such file or folder; make tracks with extract")
    if not found:
        raise RequestError("no track given; name a folder of tracks")
    names = [path.stem for path in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RequestError(f"two tracks named {', '.join(twice)}; each clip may be given once")
    return found


def attribution_of(
    path: Path, rows: dict[str, Attribution] | None, table: Path | None
) -> Attribution:
    """The row of the clip of a track file; without a table, one that says nothing is known.

    Raises:
        RequestError: the table has no row for the clip.
    """
    if rows is None:
        return Attribution(path.stem, path.stem, True, "not stated", "not stated")
    if path.stem not in rows:
        raise RequestError(f"{path}: no row for '{path.stem}' in {table}; add one (ship yes or no)")
    return rows[path.stem]


def refuse_other_files(out: Path) -> None:
    """Check that ``out`` can be written and that nothing else is lost by it.

    Raises:
        RequestError: it is a folder, or a file of another kind.
    """
    if out.is_dir():
        raise RequestError(f"--out {out}: is a folder; name a file")
    if out.exists():
        try:
            read_npz(out, SCHEMA, VERSION)
        except RequestError as error:
            raise RequestError(f"{error}; it is in the way of --out, so remove it first") from None


def describe(
    clips: list[tuple[str, Attribution, ClipMotion]],
    settings: MotionSettings,
    detectors: list[dict[str, Any]],
    withheld: int,
) -> dict[str, Any]:
    """The library's metadata: what it is made of, how, and what was cut."""
    used = [clip for clip in clips if clip[2].runs]
    return {
        "camera_model": CAMERA_MODEL,
        "head_pose": HEAD_POSE,
        "mouth": MOUTH_MODEL,
        "settings": asdict(settings),
        "detectors": [d for i, d in enumerate(detectors) if d not in detectors[:i]],
        "attribution": {name: row.record() for name, row, _ in used},
        "clips": {name: clip_row(motion, row.subject) for name, row, motion in clips},
        "withheld_clips": withheld,
        "versions": {"numpy": np.__version__, "library_schema": VERSION},
    }


def summary(library: MotionLibrary) -> str:
    """One line on a library."""
    subjects = len(set(library.run_subject.tolist()))
    shortest = float(np.min(library.run_length - 1)) / library.fps
    return (
        f"{library.seconds:.1f} s in {len(library.run_start)} runs of {subjects} subjects, "
        f"the shortest {shortest:.1f} s"
    )
