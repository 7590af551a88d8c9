"""Folds of people: nobody is in two of them."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.dataset.sequences import ClipFrames, Sequences
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.tracking.crop import Crop
from face_prediction.tracking.lifting import LIPS
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

#: What the share of all footage counts beside that of a person's own kinds. Little: kinds are
#: reported apart and every fold is chosen by once, so that each should hold some of every kind;
#: with more, the 400 clips of one GRID speaker would have a fold to themselves.
ALL_FOOTAGE = 0.25


@dataclass(frozen=True)
class Amount:
    """Sequences of one clip: who is in it, what kind of footage it is, and how many."""

    subject: str
    kind: str
    sequences: int


def assign_folds(amounts: Sequence[Amount], folds: int, seed: int) -> dict[str, int]:
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
    for amount in amounts:
        by_subject[amount.subject][amount.kind] += amount.sequences
        of_kind[amount.kind] += amount.sequences
    total = sum(of_kind.values())
    people = [name for name in sorted(by_subject) if sum(by_subject[name].values()) > 0]
    if len(people) < folds:
        raise RequestError(
            f"--folds {folds}: only {len(people)} subjects have sequences; give at most that many"
        )
    rng = np.random.default_rng([seed, *b"folds"])
    shuffled = [people[i] for i in rng.permutation(len(people))]
    shuffled.sort(key=lambda name: -sum(by_subject[name].values()))
    held = [defaultdict(int) for _ in range(folds)]
    result: dict[str, int] = {}
    for name in shuffled:
        fold = min(range(folds), key=lambda k: _fullness(held[k], by_subject[name], of_kind, total))
        result[name] = fold
        for kind, count in by_subject[name].items():
            held[fold][kind] += count
    return dict(sorted(result.items()))


def require_fold_options(folds: int, seed: int) -> None:
    """Check both numbers before any work is done.

    Raises:
        RequestError: one is out of its range.
    """
    if folds < 1:
        raise RequestError(f"--folds {folds}: 1 or more")
    if seed < 0:
        raise RequestError(f"--seed {seed}: 0 or more")


def _fullness(
    held: Mapping[str, int], new: Mapping[str, int], of_kind: Mapping[str, int], total: int
) -> tuple[float, int]:
    """How full a fold is of the kinds that ``new`` would add to, and of everything."""
    everything = sum(held.values())
    own = [held.get(kind, 0) / of_kind[kind] for kind, count in new.items() if count]
    return float(np.mean(own)) + ALL_FOOTAGE * everything / total, everything


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


SCHEMA = "face_dataset"
VERSION = 1
MANIFEST_NAME = "dataset.json"
TABLE_NAME = "sequences.csv"
CLIP_FOLDER = "clips"


@dataclass(frozen=True)
class ClipEntry:
    """One clip of a dataset; its file is ``clips/<clip>.h5``."""

    clip: str
    subject: str
    kind: str
    #: None where the clip has no sequence and its subject none either
    fold: int | None
    #: whether numbers measured on the clip may be redistributed
    ship: bool
    licence: str
    source: str
    track_sha256: str
    video: str
    video_sha256: str
    #: sequences kept, sequences looked at, and why the others were dropped
    sequences: int
    candidates: int
    dropped: dict[str, int]


@dataclass(frozen=True)
class Manifest:
    """What a dataset is made of and how it is split."""

    settings: SequenceSettings
    folds: int
    #: of the tie-breaks between folds
    seed: int
    clips: tuple[ClipEntry, ...]

    def to_json(self) -> dict[str, Any]:
        """What `read_manifest` takes."""
        return {
            "schema": SCHEMA,
            "version": VERSION,
            "settings": self.settings.to_json(),
            "folds": self.folds,
            "seed": self.seed,
            "subjects": {c.subject: c.fold for c in self.clips if c.fold is not None},
            "clips": [asdict(clip) for clip in self.clips],
        }


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``dataset.json``, whole or not at all."""
    with atomic_file(folder / MANIFEST_NAME) as temporary:
        text = json.dumps(manifest.to_json(), indent=1, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> Manifest:
    """Read and check ``dataset.json``.

    Raises:
        RequestError: it is absent, damaged, of another schema or version, or says that one person
            is in two folds.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        raise RequestError(
            f"{folder}: no dataset ({MANIFEST_NAME} is not there); make one with build-dataset"
        )
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RequestError(f"{path}: cannot be read ({error}); make the dataset again") from None
    schema = data.get("schema") if isinstance(data, dict) else None
    if schema != SCHEMA or data.get("version") != VERSION:
        version = data.get("version") if isinstance(data, dict) else None
        raise RequestError(
            f"{path}: schema '{schema}' version {version}, expected '{SCHEMA}' {VERSION}; "
            "make the dataset again"
        )
    try:
        clips = tuple(_entry(row) for row in data["clips"])
        settings = SequenceSettings.from_json(data["settings"])
        manifest = Manifest(settings, int(data["folds"]), int(data["seed"]), clips)
    except (KeyError, TypeError, ValueError) as error:
        raise RequestError(f"{path}: not as expected ({error}); make the dataset again") from None
    _check_folds(path, manifest)
    return manifest


def _entry(row: Any) -> ClipEntry:
    wanted = {item.name for item in fields(ClipEntry)}
    if not isinstance(row, dict) or set(row) != wanted:
        raise RequestError(f"a clip needs the keys {', '.join(sorted(wanted))}")
    return ClipEntry(**row)


def _check_folds(path: Path, manifest: Manifest) -> None:
    fold_of: dict[str, int | None] = {}
    for clip in manifest.clips:
        if Path(clip.clip).name != clip.clip:
            raise RequestError(f"{path}: '{clip.clip}' is no name of a clip")
        if clip.sequences and clip.fold not in range(manifest.folds):
            raise RequestError(
                f"{path}: clip '{clip.clip}' is in fold {clip.fold}, there are {manifest.folds}"
            )
        if fold_of.setdefault(clip.subject, clip.fold) != clip.fold:
            raise RequestError(f"{path}: subject '{clip.subject}' is in two folds")
    if len({clip.clip for clip in manifest.clips}) < len(manifest.clips):
        raise RequestError(f"{path}: a clip is there twice")


@dataclass(frozen=True)
class SequenceRow:
    """One sequence: where it is, who and what it shows, and its facts (see `FACTS`)."""

    clip: str
    #: among the sequences of its clip
    number: int
    subject: str
    kind: str
    fold: int
    #: first frame, in the clip at the dataset's rate
    start: int
    facts: dict[str, float]


def write_table(folder: Path, rows: Sequence[SequenceRow]) -> None:
    """Write ``sequences.csv``, whole or not at all."""
    with (
        atomic_file(folder / TABLE_NAME) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as stream,
    ):
        table = csv.writer(stream, lineterminator="\n")
        names = [fact.name for fact in FACTS]
        table.writerow(["clip", "number", "subject", "kind", "fold", "start", *names])
        for row in rows:
            numbers = [f"{row.facts[name]:.6g}" for name in names]
            table.writerow(
                [row.clip, row.number, row.subject, row.kind, row.fold, row.start, *numbers]
            )


@dataclass(frozen=True)
class Fact:
    """A column of the table of sequences."""

    name: str
    unit: str
    description: str


FACTS: tuple[Fact, ...] = (
    Fact("start_time", "s", "Time of the first frame on the video's clock"),
    Fact("mouth_range_u", "crop", "Largest less smallest u of the mouth centre"),
    Fact("mouth_range_v", "crop", "Largest less smallest v of the mouth centre"),
    Fact("mouth_range_x", "m", "The same of its lifted position, x"),
    Fact("mouth_range_y", "m", "... y"),
    Fact("mouth_range_z", "m", "... z (away from the camera; the least certain)"),
    Fact("head_rotation_range", "deg", "Largest angle between the head's orientations in any two"),
    Fact("mouth_opening_range", "m", "Largest less smallest distance between the inner lips"),
    Fact("interpolated_share", "1", "Share of frames made from two decoded ones"),
    Fact("image_lag", "s", "Longest time between a frame and the picture that stands for it"),
    Fact("crop_side", "px", "Side of the crop in the video"),
    Fact("crop_padding", "1", "Share of the crop outside the video's picture (black)"),
    Fact("outside_share", "1", "Share of the frames to predict in which the face leaves the crop"),
)


def sequence_facts(
    frames: ClipFrames, sequences: Sequences, settings: SequenceSettings
) -> dict[str, np.ndarray]:
    """The columns of `FACTS`, each (N,) float64."""
    rows = [
        _facts_of(frames, int(start), crop, settings)
        for start, crop in zip(sequences.start, sequences.crops, strict=True)
    ]
    return {
        fact.name: np.array([row[fact.name] for row in rows], dtype=np.float64) for fact in FACTS
    }


def largest_angle(orientation: np.ndarray) -> float:
    """Largest angle in degrees between any two of the unit quaternions (F, 4)."""
    cosine = np.abs(orientation @ orientation.T).min()
    return float(np.degrees(2 * np.arccos(np.clip(cosine, 0.0, 1.0))))


def _facts_of(
    frames: ClipFrames, start: int, crop: Crop, settings: SequenceSettings
) -> dict[str, float]:
    part = slice(start, start + settings.length)
    points = crop.normalise(frames.landmarks[part], frames.image_size)[..., :2]  # (F, 468, 2)
    centre = points[:, list(LIPS)].mean(axis=1)
    u, v = np.ptp(centre, axis=0)
    x, y, z = np.ptp(frames.mouth[part], axis=0)
    future = points[settings.history :]
    outside = np.any((future < 0.0) | (future > 1.0), axis=(1, 2))
    return {
        "start_time": float(frames.timestamps[start]),
        "mouth_range_u": float(u),
        "mouth_range_v": float(v),
        "mouth_range_x": float(x),
        "mouth_range_y": float(y),
        "mouth_range_z": float(z),
        "head_rotation_range": largest_angle(frames.orientation[part]),
        "mouth_opening_range": float(np.ptp(frames.jaw[part])),
        "interpolated_share": float(frames.interpolated[part].mean()),
        "image_lag": float(np.abs(frames.image_lag[part]).max()),
        "crop_side": float(crop.side),
        "crop_padding": crop.padding(frames.image_size),
        "outside_share": float(outside.mean()),
    }
