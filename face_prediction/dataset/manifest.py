"""Manifest of a dataset: its clips, their split into folds by person, the table of sequences."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from face_prediction.dataset.sequences import STATISTICS, SequenceSettings
from robo_manip_baselines.runs.documents import Schema, read_json, shown
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file, to_json, write_text
from robo_manip_baselines.runs.ranges import NonNegativeInt, Seed, require_range

SCHEMA = Schema("face_dataset", 1)
MAX_BYTES = 64 << 20
"""Size of the manifest: some 100,000 clips."""

MANIFEST_NAME = "dataset.json"
TABLE_NAME = "sequences.csv"
TABLE_START = "clip,number,subject,kind,fold,start"
CLIP_FOLDER = "clips"

ALL_FOOTAGE = 0.25
"""Weight of a fold's share of all footage beside its share of a person's own kinds. Little: kinds
are reported apart, so that each fold should hold some of every kind; with more, the 400 clips of
one GRID speaker would have a fold to themselves."""


Folds = Annotated[int, Interval(ge=1, le=1000)]


@dataclass(frozen=True)
class ClipEntry:
    """One clip of a dataset; its file is ``clips/<clip>.h5``.

    Attributes:
        clip: name.
        subject: the person.
        kind: one of `KINDS`.
        fold: None where neither the clip nor another of its subject has a sequence.
        ship: numbers measured on the clip may be redistributed.
        licence: terms of use.
        source: origin.
        track_sha256: of the track's file.
        video: name of the video's file.
        video_sha256: of it.
        sequences: sequences kept.
        candidates: sequences tried.
        dropped: how many were dropped for each reason.
        content_sha256: of the content of the clip's file; empty in datasets of older releases.
    """

    clip: str
    subject: str
    kind: str
    fold: NonNegativeInt | None
    ship: bool
    licence: str
    source: str
    track_sha256: str
    video: str
    video_sha256: str
    sequences: NonNegativeInt
    candidates: NonNegativeInt
    dropped: dict[str, NonNegativeInt]
    content_sha256: str = ""


@dataclass(frozen=True)
class Manifest:
    """Clips of a dataset and their split.

    Attributes:
        settings: of the sequences.
        folds: how many.
        seed: of the tie-breaks between folds.
        clips: in the order of the sequences.
    """

    settings: SequenceSettings
    folds: Folds
    seed: Seed
    clips: tuple[ClipEntry, ...]

    def __post_init__(self) -> None:
        fold_of: dict[str, int | None] = {}
        for clip in self.clips:
            if Path(clip.clip).name != clip.clip:
                raise RequestError(f"{shown(clip.clip)} is no name of a clip")
            if clip.sequences and clip.fold not in range(self.folds):
                wrong = f"is in fold {clip.fold}, there are {self.folds}"
                raise RequestError(f"clip '{clip.clip}' {wrong}")
            if fold_of.setdefault(clip.subject, clip.fold) != clip.fold:
                raise RequestError(f"subject '{clip.subject}' is in two folds")
        if len({clip.clip for clip in self.clips}) < len(self.clips):
            raise RequestError("a clip is there twice")


@dataclass(frozen=True)
class ManifestDocument:
    """Content of ``dataset.json``; see `Manifest`. ``subjects``: fold of each person."""

    settings: dict[str, Any]
    folds: Folds
    seed: Seed
    subjects: dict[str, NonNegativeInt]
    clips: tuple[ClipEntry, ...]


def assign_folds(clips: Iterable[ClipEntry], folds: int, seed: int) -> dict[str, int]:
    """A fold for every subject, so that folds hold about as much of each kind, and in all.

    The person with the most sequences goes first, each to the fold that then holds the least of
    the person's own kinds (and, counting less, of everything). ``seed`` breaks ties. The result
    depends on what there is, not on its order.

    Raises:
        RequestError: there are fewer people with sequences than folds.
    """
    require_fold_options(folds, seed)
    by_subject: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    of_kind: dict[str, int] = defaultdict(int)
    for clip in clips:
        by_subject[clip.subject][clip.kind] += clip.sequences
        of_kind[clip.kind] += clip.sequences
    total = sum(of_kind.values())
    people = [name for name in sorted(by_subject) if sum(by_subject[name].values()) > 0]
    if len(people) < folds:
        limit = f"only {len(people)} subjects have sequences; give at most that many"
        raise RequestError(f"--folds {folds}: {limit}")
    rng = np.random.default_rng([seed, *b"folds"])
    shuffled = [people[i] for i in rng.permutation(len(people))]
    shuffled.sort(key=lambda name: -sum(by_subject[name].values()))
    held: list[dict[str, int]] = [defaultdict(int) for _ in range(folds)]

    def fullness(fold: int, new: Mapping[str, int]) -> tuple[float, int]:
        everything = sum(held[fold].values())
        own = [held[fold][kind] / of_kind[kind] for kind, count in new.items() if count]
        return float(np.mean(own)) + ALL_FOOTAGE * everything / total, everything

    result: dict[str, int] = {}
    for name in shuffled:
        new = by_subject[name]
        result[name] = min(range(folds), key=lambda fold: fullness(fold, new))
        for kind, count in new.items():
            held[result[name]][kind] += count
    return dict(sorted(result.items()))


def require_fold_options(folds: int, seed: int) -> None:
    """Raise RequestError if a number is out of its range, before any work is done."""
    require_range("--folds", folds, Folds)
    require_range("--seed", seed, Seed)


@dataclass(frozen=True)
class FoldSplit:
    """Folds to train on, to choose by, and to report on; perhaps none of the first two."""

    train: tuple[int, ...]
    validation: tuple[int, ...]
    test: tuple[int, ...]


def fold_split(folds: int, test: int) -> FoldSplit:
    """The split that reports on fold ``test``: the next fold validates, the others train.

    With two folds none validates; with one, a dataset to be reported on only, none trains.

    Raises:
        RequestError: there is no such fold.
    """
    if not 0 <= test < folds:
        raise RequestError(f"fold {test}: this dataset has folds 0 to {folds - 1}")
    others = [(test + i) % folds for i in range(1, folds)]
    validation = others[:1] if folds > 2 else []
    train = [fold for fold in others if fold not in validation]
    return FoldSplit(tuple(sorted(train)), tuple(validation), (test,))


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``dataset.json``, whole or not at all."""
    content = {
        **SCHEMA.to_json(),
        "settings": manifest.settings.to_json(),
        "folds": manifest.folds,
        "seed": manifest.seed,
        "subjects": {c.subject: c.fold for c in manifest.clips if c.fold is not None},
        "clips": [asdict(clip) for clip in manifest.clips],
    }
    write_text(folder / MANIFEST_NAME, to_json(content, indent=1))


def read_manifest(folder: Path) -> Manifest:
    """Read and check ``dataset.json``.

    Raises:
        RequestError: it is absent, damaged, of another schema or version, or says that one person
            is in two folds.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        missing = f"no dataset ({MANIFEST_NAME} is not there)"
        raise RequestError(f"{folder}: {missing}; make one with build-dataset")
    try:
        stored = read_json(path, ManifestDocument, SCHEMA, limit=MAX_BYTES)
        settings = SequenceSettings.from_json(stored.settings)
        return Manifest(settings, stored.folds, stored.seed, stored.clips)
    except RequestError as error:
        text = str(error) if str(path) in str(error) else f"'{path}': {error}"
        raise RequestError(f"{text}; make the dataset again") from None


@dataclass(frozen=True)
class SequenceRow:
    """One sequence in the table of sequences.

    Attributes:
        clip: its clip.
        number: among the sequences of its clip.
        subject: the person.
        kind: one of `KINDS`.
        fold: the person's.
        start: first frame, in the clip at the dataset's rate.
        statistics: by the names of `STATISTICS`.
    """

    clip: str
    number: int
    subject: str
    kind: str
    fold: int
    start: int
    statistics: dict[str, float]


def write_table(folder: Path, rows: Sequence[SequenceRow]) -> None:
    """Write ``sequences.csv``, whole or not at all."""
    with (
        atomic_file(folder / TABLE_NAME) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as stream,
    ):
        table = csv.writer(stream, lineterminator="\n")
        table.writerow([*TABLE_START.split(","), *STATISTICS])
        for row in rows:
            place = [row.clip, row.number, row.subject, row.kind, row.fold, row.start]
            table.writerow([*place, *(f"{row.statistics[name]:.6g}" for name in STATISTICS)])
