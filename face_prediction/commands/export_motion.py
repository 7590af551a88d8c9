"""``face-prediction export-motion``: face tracks in, one library of recorded motion out."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from face_prediction.motion.library import (
    MOTION_LIBRARY,
    lift_clips,
    load_motion,
    record_motion,
    save_motion,
    track_files,
    with_base,
    with_people,
)
from face_prediction.motion.motion import MotionSettings
from face_prediction.motion.report import (
    require_report,
    write_report,
    write_splice_report,
)
from face_prediction.motion.splice import SpliceSettings, splice_clips
from robo_manip_baselines.runs.files import require_out_file

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ExportMotionOptions:
    """Lift face tracks to metres, cut out what cannot be trusted, and write the runs.

    Only clips whose row says ship=yes are taken. Without --attribution every clip is taken, each
    as a subject of its own, and its licence is recorded as not stated.

    Example: face-prediction export-motion face_tracks --attribution clips.csv --out motion.npz

    Attributes:
        tracks: Folders of tracks, or single tracks.
        out: The library to write.
        attribution: Table (.csv, or Markdown) with the columns clip, subject, ship (yes or no),
            licence, source.
        report: Markdown page to put tables and plots into, between its marks; made if absent. With
            --splice, those of the spliced runs, between marks of their own.
        test_people: Subjects of evaluation; all others are those of demonstrations, and the library
            stores both. If none is given, environments split people by a rule of their own.
        base: Older library of the same clips: its runs are taken as they are, bit for bit, and new
            ones, with --splice, come after them. Forecasts in it are left out.
        settings: Settings of the motion.
        splicing: --splice joins what is left of each person's clips to further runs, which come
            last; each sample says whether it is a blend and whether it is played backwards.
    """

    tracks: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("face_motion.npz")
    attribution: Path | None = None
    report: Path | None = None
    test_people: tuple[str, ...] = ()
    base: Path | None = None
    settings: tyro.conf.OmitArgPrefixes[MotionSettings] = field(default_factory=MotionSettings)
    splicing: tyro.conf.OmitArgPrefixes[SpliceSettings] = field(default_factory=SpliceSettings)


def run_export_motion(options: ExportMotionOptions) -> None:
    """Write the library and, if asked, its report.

    Raises:
        RequestError: a track or the table cannot be used, or no run is left.
    """
    inputs = [*options.tracks, options.attribution, options.base]
    is_spliced = options.splicing.splice
    if options.report is not None:
        names = [] if is_spliced else [path.stem for path in track_files(options.tracks)]
        require_report(options.report, [*inputs, options.out], names, is_spliced)
    require_out_file(options.out, MOTION_LIBRARY, inputs)
    base = None if options.base is None else load_motion(options.base)
    clips, withheld = lift_clips(options.tracks, options.attribution, options.settings)
    parts = [(clip.row.clip, clip.row.subject, clip.motion) for clip in clips]
    spliced = splice_clips(parts, options.splicing, options.settings) if is_spliced else []
    library = record_motion(clips, options.settings, withheld, spliced, options.splicing)
    library = with_people(library, options.test_people)
    library = library if base is None else with_base(library, base)
    if options.report is not None and is_spliced:  # whose names are known only now
        require_report(options.report, inputs, [clip.name for clip in spliced], is_spliced)
    save_motion(options.out, library)
    logger.info("%s: %s", options.out, library.summary())
    if options.report is not None:
        if is_spliced:
            write_splice_report(options.report, library, spliced)
        else:
            write_report(options.report, library, clips)
        logger.info("report in %s", options.report)
