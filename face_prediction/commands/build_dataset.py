"""``face-prediction build-dataset``: tracks and videos in, a folder of sequences out."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.dataset.build import (
    build_clip,
    clip_entry,
    find_videos,
    fold_table,
    kind_table,
)
from face_prediction.dataset.manifest import (
    CLIP_FOLDER,
    MANIFEST_NAME,
    TABLE_NAME,
    TABLE_START,
    ClipEntry,
    Folds,
    Manifest,
    assign_folds,
    read_manifest,
    require_fold_options,
    write_manifest,
    write_table,
)
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings, kind_of
from face_prediction.motion.attribution import Attribution, find_row, read_attributions
from face_prediction.motion.library import track_files
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import (
    FolderKind,
    locked,
    remove_temporaries,
    require_out_folder,
)
from robo_manip_baselines.runs.ranges import Seed

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class BuildDatasetOptions:
    """Cut face tracks and their videos into sequences to learn from, split by person.

    A clip that is already there, made from the same track and video with the same settings, is
    kept: a run that was stopped carries on when started again.

    Example: face-prediction build-dataset face_tracks --videos clips --attribution clips.csv

    Attributes:
        tracks: Folders of tracks, or single tracks.
        videos: Folders that hold the videos that the tracks were made from.
        out: Folder for the dataset.
        attribution: Table (.csv, or Markdown) with the columns clip, subject, ship, licence,
            source, and optionally kind (natural, head_motion or grid) and what. Clips without kind
            and what are classified by how far the head turns.
        same_person: Subjects of the table that are one person, as NAME=OTHER: NAME becomes OTHER.
        settings: Settings of the sequences.
        folds: Parts that people are divided into; 1: nobody is trained on, all are reported on.
        seed: Breaks ties when people are divided.
        progress: Show a progress bar for every clip.
    """

    tracks: tyro.conf.Positional[tuple[Path, ...]]
    videos: tuple[Path, ...]
    out: Path = Path("face_dataset")
    attribution: Path | None = None
    same_person: tuple[str, ...] = ()
    settings: tyro.conf.OmitArgPrefixes[SequenceSettings] = field(default_factory=SequenceSettings)
    folds: Folds = 5
    seed: Seed = 0
    progress: bool = True


def run_build_dataset(options: BuildDatasetOptions) -> int:
    """Build every clip; one that cannot be used is named and the others go on.

    Returns:
        0, or 2 when some clip could not be used.

    Raises:
        RequestError: nothing could be started, no sequence is left, or one video is there as two
            people's.
    """
    require_fold_options(options.folds, options.seed)
    require_out_folder(options.out, DATASET, [*options.tracks, *options.videos])
    with locked(options.out, is_kept=False):
        remove_temporaries(options.out, options.out / CLIP_FOLDER)
        return _build_dataset(options)


def _build_dataset(options: BuildDatasetOptions) -> int:
    paths = track_files(options.tracks)
    videos = find_videos(options.videos)
    rows = read_rows(paths, options.attribution)
    rows = with_one_name(rows, options.same_person)
    for row in rows.values():
        kind_of(row)  # refuses what is no kind, before anything is read
    entries: list[ClipEntry] = []
    made = 0
    for number, path in enumerate(paths, start=1):
        prefix = f"[{number}/{len(paths)}] "
        try:
            with logging_redirect_tqdm():
                bar = prefix if options.progress else None
                made += build_clip(path, videos, options.out, options.settings, bar)
        except RequestError as error:
            if len(paths) == 1:
                raise
            logger.error("%s%s", prefix, error)
            continue
        entries.append(clip_entry(options.out, rows[path.stem]))
    if not any(entry.sequences for entry in entries):
        raise RequestError(
            f"no sequence of {options.settings.length} frames in {len(entries)} clips; "
            "give longer clips, or ask for fewer frames (--history)"
        )
    refuse_same_video(entries)
    folds = assign_folds(entries, options.folds, options.seed)
    placed = tuple(replace(entry, fold=folds.get(entry.subject)) for entry in entries)
    manifest = Manifest(options.settings, options.folds, options.seed, placed)
    write_manifest(options.out, manifest)
    with FaceDataset(options.out) as dataset:
        table = dataset.rows()
    write_table(options.out, table)
    print(kind_table(placed, table))  # noqa: T201
    print()  # noqa: T201
    print(fold_table(placed, options.folds))  # noqa: T201
    kept, refused = len(entries) - made, len(paths) - len(entries)
    logger.info("%d made, %d already up to date, %d refused", made, kept, refused)
    logger.info("%s: %d sequences in %d folds", options.out, len(table), options.folds)
    return 2 if refused else 0


def read_rows(tracks: Iterable[Path], table: Path | None) -> dict[str, Attribution]:
    """The row of every clip; a clip without a row is a person of its own and may not ship.

    Raises:
        RequestError: the table cannot be used.
    """
    known = {} if table is None else read_attributions(table)
    clips = [path.stem for path in tracks]
    found = {clip: find_row(known, clip) for clip in clips}
    unknown = [clip for clip, row in found.items() if row is None]
    if unknown:
        names = ", ".join(unknown[:3] + ["..."] * (len(unknown) > 3))
        what = "%d clips have no row in --attribution (%s): each counts as a person of its own"
        logger.warning(what, len(unknown), names)
    return {clip: row or Attribution(clip, clip, False) for clip, row in found.items()}


def with_one_name(
    rows: Mapping[str, Attribution], same_person: Sequence[str]
) -> dict[str, Attribution]:
    """The rows, with one name for every person.

    Args:
        rows: by clip.
        same_person: NAME=OTHER each; of A=B and B=C, all three are one person.

    Raises:
        RequestError: one is of another form, there is nobody of that name, or a name is to become
            two others or, in the end, itself.
    """
    names = {row.subject for row in rows.values()}
    other: dict[str, str] = {}
    for pair in same_person:
        name, equals, same = pair.partition("=")
        if not (name and equals and same):
            raise RequestError(f"--same_person {pair}: no pair of names; valid: NAME=OTHER")
        require_choice("subject of --same_person", name, names)
        if other.setdefault(name, same) != same:
            raise RequestError(
                f"--same_person {name}={other[name]} {pair}: '{name}' becomes two; name one, and "
                f"say {other[name]}={same} if these are one person, too"
            )

    def last(name: str) -> str:
        passed = [name]
        while passed[-1] in other:
            passed.append(other[passed[-1]])
            if passed[-1] in passed[:-1]:
                circle = ", ".join(passed)
                raise RequestError(f"--same_person: goes in a circle ({circle}); leave one out")
        return passed[-1]

    return {clip: replace(row, subject=last(row.subject)) for clip, row in rows.items()}


def refuse_same_video(entries: Iterable[ClipEntry]) -> None:
    """Raise RequestError if one video is of two people: trained on and reported on."""
    seen: dict[str, ClipEntry] = {}
    for entry in entries:
        first = seen.setdefault(entry.video_sha256, entry)
        if first.subject != entry.subject:
            raise RequestError(
                f"clips '{first.clip}' and '{entry.clip}' are one video, of subjects "
                f"'{first.subject}' and '{entry.subject}'; give both the same subject"
            )


def _is_dataset(folder: Path) -> bool:
    if not (folder / MANIFEST_NAME).exists():
        return False
    try:
        read_manifest(folder)
    except RequestError as error:
        raise RequestError(f"{error}; it is in the way of --out, so remove it first") from None
    return True


def _is_begun(path: Path) -> bool:
    if path.name == TABLE_NAME:
        return path.is_file() and path.read_bytes().startswith(TABLE_START.encode())
    names = [item.name for item in path.iterdir()] if path.is_dir() else [""]
    return path.name == CLIP_FOLDER and all(name.endswith((".h5", ".partial")) for name in names)


DATASET = FolderKind("dataset", _is_dataset, begun=_is_begun)
