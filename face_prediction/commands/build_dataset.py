"""``face-prediction build-dataset``: tracks and videos in, a folder of sequences out."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.commands.export_motion import track_files
from face_prediction.dataset.build import ClipSource, build_clip, fold_table, kind_table
from face_prediction.dataset.clip_file import open_clip, read_record
from face_prediction.dataset.manifest import (
    CLIP_FOLDER,
    MANIFEST_NAME,
    TABLE_NAME,
    Amount,
    ClipEntry,
    Manifest,
    assign_folds,
    read_manifest,
    require_fold_options,
    write_manifest,
    write_table,
)
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.settings import CropFrom, SequenceSettings, kind_of
from face_prediction.motion.library import Attribution, read_attributions
from face_prediction.tracking.tracks import load_track
from face_prediction.tracking.video import FrameBar
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class BuildDatasetOptions:
    """Cut face tracks and their videos into sequences to learn from, split by person.

    A clip that is already there, made from the same track and video with the same settings, is
    kept: a run that was stopped carries on when started again.

    Example: face-prediction build-dataset face_tracks --videos clips --attribution clips.csv
    """

    #: Folders of tracks, or single tracks.
    tracks: tyro.conf.Positional[tuple[Path, ...]]
    #: Folders that hold the videos that the tracks were made from.
    videos: tuple[Path, ...]
    #: Folder for the dataset.
    out: Path = Path("face_dataset")
    #: Table (.csv, or Markdown) with the columns clip, subject, ship, licence, source, and where
    #: there are such, kind (natural, head_motion or grid) and what.
    attribution: Path | None = None
    #: Frames that a predictor is shown.
    history: int = SequenceSettings.history
    #: Frames that it predicts.
    future: int = SequenceSettings.future
    #: Frames per second of the sequences.
    fps: float = SequenceSettings.fps
    #: Frames between the starts of neighbouring sequences.
    stride: int = SequenceSettings.stride
    #: Room on each side of the face, in lengths of the longer side of the box around it.
    margin: float = SequenceSettings.margin
    #: Frames that the crop is laid around. With sequence the face never leaves it, but where the
    #: crop lies tells where the face is going.
    crop_from: CropFrom = SequenceSettings.crop_from
    #: Side of the pictures in pixels.
    crop_size: int = SequenceSettings.crop_size
    #: Of the JPEG pictures, 1 to 100.
    quality: int = SequenceSettings.quality
    #: Parts that people are divided into; 1: nobody is trained on, all are reported on.
    folds: int = 5
    #: Breaks ties when people are divided.
    seed: int = 0
    #: Show a progress bar for every clip.
    progress: bool = True


def run_build_dataset(options: BuildDatasetOptions) -> int:
    """Build every clip; one that cannot be used is named and the others go on.

    Returns:
        0, or 2 when some clip could not be used.

    Raises:
        RequestError: nothing could be started, or no dataset comes of it.
    """
    settings = SequenceSettings(
        history=options.history,
        future=options.future,
        fps=options.fps,
        stride=options.stride,
        margin=options.margin,
        crop_from=options.crop_from,
        crop_size=options.crop_size,
        quality=options.quality,
    )
    require_fold_options(options.folds, options.seed)
    refuse_other_folder(options.out)
    paths = track_files(options.tracks)
    videos = find_videos(options.videos)
    rows = read_rows(paths, options.attribution)
    kinds = {clip: kind_of(row) for clip, row in rows.items()}
    usable: list[str] = []
    made = kept = refused = 0
    for number, path in enumerate(paths, start=1):
        prefix = f"[{number}/{len(paths)}] "
        out = options.out / CLIP_FOLDER / f"{path.stem}.h5"
        try:
            source = ClipSource(path.stem, path, video_of(path, videos))
            with logging_redirect_tqdm():
                is_made = build_clip(source, out, settings, FrameBar(prefix, options.progress))
        except RequestError as error:
            if len(paths) == 1:
                raise
            refused += 1
            logger.error("%s%s", prefix, error)
            continue
        made += is_made
        kept += not is_made
        usable.append(path.stem)
    entries = [clip_entry(options.out, rows[clip], kinds[clip]) for clip in usable]
    sequences = finish(options, settings, entries)
    logger.info("%d made, %d already up to date, %d refused", made, kept, refused)
    logger.info("%s: %d sequences in %d folds", options.out, sequences, options.folds)
    return 2 if refused else 0


def finish(
    options: BuildDatasetOptions, settings: SequenceSettings, entries: Sequence[ClipEntry]
) -> int:
    """Divide the people into folds, write the list and the table, and print the closing tables.

    Returns:
        How many sequences there are.

    Raises:
        RequestError: too few people have sequences, or one video is there as two people's.
    """
    if not any(entry.sequences for entry in entries):
        raise RequestError(
            f"no sequence of {settings.length} frames in {len(entries)} clips; "
            "give longer clips, or ask for fewer frames (--history)"
        )
    refuse_same_video(entries)
    amounts = [Amount(entry.subject, entry.kind, entry.sequences) for entry in entries]
    folds = assign_folds(amounts, options.folds, options.seed)
    placed = tuple(replace(entry, fold=folds.get(entry.subject)) for entry in entries)
    write_manifest(options.out, Manifest(settings, options.folds, options.seed, placed))
    with FaceDataset(options.out) as dataset:
        rows = dataset.rows()
    write_table(options.out, rows)
    print(kind_table(placed, rows))  # noqa: T201
    print()  # noqa: T201
    print(fold_table(placed, options.folds))  # noqa: T201
    return len(rows)


def find_videos(folders: Iterable[Path]) -> dict[str, list[Path]]:
    """File name to the files of that name in ``folders``.

    Raises:
        RequestError: one is no folder.
    """
    found: dict[str, list[Path]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise RequestError(f"--videos {folder}: no such folder")
        for path in sorted(folder.iterdir()):
            if path.is_file():
                found.setdefault(path.name, []).append(path)
    return found


def video_of(track: Path, videos: dict[str, list[Path]]) -> Path:
    """The video that a track names as its source.

    Raises:
        RequestError: there is none of that name, or several.
    """
    name = str(load_track(track).source.get("name", ""))
    found = videos.get(name, [])
    if not found:
        raise RequestError(f"{track}: its video '{name}' is in no folder of --videos")
    if len(found) > 1:
        raise RequestError(f"{track}: {' and '.join(map(str, found))} are both named '{name}'")
    return found[0]


def read_rows(tracks: Iterable[Path], table: Path | None) -> dict[str, Attribution]:
    """The row of every clip; one without a row is a person of its own, whose numbers stay here.

    Raises:
        RequestError: the table cannot be used.
    """
    known = {} if table is None else read_attributions(table)
    clips = [path.stem for path in tracks]
    unknown = [clip for clip in clips if clip not in known]
    if unknown:
        logger.warning(
            "%d clips have no row in --attribution (%s%s): each counts as a person of its own",
            len(unknown),
            ", ".join(unknown[:3]),
            ", ..." if len(unknown) > 3 else "",
        )
    return {
        clip: known.get(clip, Attribution(clip, clip, False, "not stated", "not stated"))
        for clip in clips
    }


def clip_entry(out: Path, row: Attribution, kind: str) -> ClipEntry:
    """The entry of a clip whose file is there, not yet in a fold."""
    path = out / CLIP_FOLDER / f"{row.clip}.h5"
    with open_clip(path) as file:
        record = read_record(path, file)
    return ClipEntry(
        clip=row.clip,
        subject=row.subject,
        kind=kind,
        fold=None,
        ship=row.ship,
        licence=row.licence,
        source=row.source,
        track_sha256=record["track_sha256"],
        video=record["video"],
        video_sha256=record["video_sha256"],
        sequences=record["sequences"],
        candidates=record["candidates"],
        dropped=record["dropped"],
    )


def refuse_same_video(entries: Iterable[ClipEntry]) -> None:
    """Check that nobody can be trained on under one name and reported on under another.

    Raises:
        RequestError: the same video is there for two people.
    """
    seen: dict[str, ClipEntry] = {}
    for entry in entries:
        first = seen.setdefault(entry.video_sha256, entry)
        if first.subject != entry.subject:
            raise RequestError(
                f"clips '{first.clip}' and '{entry.clip}' are one video, of subjects "
                f"'{first.subject}' and '{entry.subject}'; give both the same subject"
            )


def refuse_other_folder(out: Path) -> None:
    """Check that ``out`` is new, empty, or a dataset, whole or begun.

    Raises:
        RequestError: it is a file, or holds something else.
    """
    if out.exists() and not out.is_dir():
        raise RequestError(f"--out {out}: is a file; name a folder")
    if (out / MANIFEST_NAME).exists():
        try:
            read_manifest(out)
        except RequestError as error:
            raise RequestError(f"{error}; it is in the way of --out, so remove it first") from None
    elif out.is_dir():
        ours = (CLIP_FOLDER, TABLE_NAME)
        names = [path.name for path in out.iterdir() if path.name not in ours]
        others = sorted(name for name in names if not name.endswith(".partial"))
        if others:
            raise RequestError(
                f"--out {out}: holds {', '.join(others[:3])} and no dataset; name another folder"
            )
