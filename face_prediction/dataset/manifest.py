"""``dataset.json`` and ``sequences.csv``: the clips and sequences of a dataset, and its folds."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from face_prediction.dataset.facts import FACTS
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.errors import RequestError
from face_prediction.whole_file import whole_file

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
    with whole_file(folder / MANIFEST_NAME) as temporary:
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
        whole_file(folder / TABLE_NAME) as temporary,
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
