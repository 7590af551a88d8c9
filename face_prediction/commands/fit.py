"""``face-prediction fit``: a dataset in, the weights of residual prediction out."""

from __future__ import annotations

import csv
import io
import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from face_prediction.dataset.manifest import MANIFEST_NAME, ClipEntry
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import NO_PART_LEFT, SplitName, split_dataset
from face_prediction.dataset.tracks import FaceStretch, dataset_stretches, without_windows
from face_prediction.evaluation.predictors import UNFITTED, dataset_landmarks
from face_prediction.forecast import FORECASTERS, fit_forecaster
from face_prediction.models.loading import (
    BASELINES_FILE,
    RESIDUAL,
    holds_residual,
    save_residual,
)
from face_prediction.models.residual.experts import EXPERTS
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import (
    FolderKind,
    file_digest,
    locked,
    require_out_folder,
    write_text,
)
from robo_manip_baselines.runs.ranges import NonNegativeInt
from robo_manip_baselines.runs.versions import software_versions

logger = logging.getLogger(__name__)

ATTRIBUTION_FILE = "attribution.csv"
_ATTRIBUTION_COLUMNS = ("clip", "subject", "licence", "source")

MOST_FRAMES = 2000
"""Frames of one person that are fitted to: a minute. More would make the fit that person's."""


@dataclass(frozen=True)
class FitOptions:
    """Fit residual prediction to a dataset's people: minutes on a core, no images, no GPU.

    The baselines, fitted to the same people, are stored beside it.

    Example: face-prediction fit --dataset face_dataset --test_fold 0

    Attributes:
        dataset: Folder made by build-dataset.
        test_fold: Fold whose people are left for the report, or part of a split by sequence. None:
            nobody is, for weights that are shipped.
        split: person: parts are the dataset's folds. sequence: ten parts of windows that do not
            overlap, drawn from the same people, as the paper's.
        ship_only: Fit only to clips whose row says ship=yes.
        out: Folder for the weights; None: checkpoints/residual_foldK, or residual_sequenceK.
    """

    dataset: Path = Path("face_dataset")
    test_fold: NonNegativeInt | None = 0
    split: SplitName = "person"
    ship_only: bool = False
    out: Path | None = None


def run_fit(options: FitOptions) -> int:
    """Fit, and write the folder.

    Raises:
        RequestError: the dataset cannot be used, or holds too few people.
    """
    name = f"residual_{'fold' if options.split == 'person' else 'sequence'}{options.test_fold}"
    out = options.out or Path("checkpoints") / name
    require_out_folder(out, WEIGHTS, [options.dataset])
    with locked(out, is_kept=False), FaceDataset(options.dataset) as dataset:
        return _fit(dataset, options, out)


def _fit(dataset: FaceDataset, options: FitOptions, out: Path) -> int:
    from face_prediction.models.learned import CheckpointRecord
    from face_prediction.models.residual.fit import HORIZONS, fit_residual

    manifest = dataset.manifest
    split = split_dataset(dataset, options.split)
    if options.test_fold is None and split.by == "sequence":
        raise RequestError(f"--split sequence --test_fold None: {NO_PART_LEFT}")
    if options.test_fold is not None and options.test_fold >= split.parts:
        valid = f"valid: 0 to {split.parts - 1}, None"
        raise RequestError(f"--test_fold {options.test_fold}: no such fold; {valid}")
    tested = [] if options.test_fold is None else [options.test_fold]
    folds = {*range(split.parts)} - {*tested}
    rows = split.training(tested)
    used = [
        clip
        for clip in manifest.clips
        if (split.by == "sequence" or clip.fold in folds) and (clip.ship or not options.ship_only)
    ]
    names = {clip.clip for clip in used}
    stretches = without_windows(dataset_stretches(dataset), split.windows(tested))
    long = [s for s in stretches if s.clip in names and len(s) >= manifest.settings.length]
    chosen = most_of_each(long)
    subjects = sorted({stretch.subject for stretch in chosen})
    logger.info("fitting to %d tracks of %d people", len(chosen), len(subjects))
    fit = fit_residual([s.landmarks for s in chosen], [s.subject for s in chosen])
    is_used = [manifest.clips[place].clip in names for place in split.clip[rows].tolist()]
    sequences = dataset_landmarks(dataset, rows[is_used])
    baselines = [fit_forecaster(kind, sequences) for kind in FORECASTERS if kind not in UNFITTED]
    record = CheckpointRecord(
        model=RESIDUAL,
        settings={"experts": [repr(expert) for expert in EXPERTS], "horizons": list(HORIZONS)},
        preset="fitted",
        training={"ship_only": options.ship_only, "most_frames": MOST_FRAMES},
        seed=0,
        dataset=manifest.settings.to_json(),
        dataset_sha256=file_digest(options.dataset / MANIFEST_NAME),
        folds={"train": sorted(folds), "validation": [], "test": tested},
        train_subjects=sorted({*subjects, *sequences.subjects}),
        step=0,
        validation={},
        versions=software_versions(),
        split=split.by,
        windows_sha256=split.windows_sha256,
    )
    write_text(out / ATTRIBUTION_FILE, attribution_csv(used, set(record.train_subjects)))
    save_residual(out, record, fit, baselines)
    logger.info("%s: residual, fitted to %d people", out, len(record.train_subjects))
    return 0


def most_of_each(stretches: Sequence[FaceStretch]) -> list[FaceStretch]:
    """The longest stretches of each person, until they hold `MOST_FRAMES`, in their order."""
    taken: dict[str, int] = defaultdict(int)
    chosen: set[int] = set()
    for number in sorted(range(len(stretches)), key=lambda n: -len(stretches[n])):
        stretch = stretches[number]
        if taken[stretch.subject] < MOST_FRAMES:
            taken[stretch.subject] += len(stretch)
            chosen.add(number)
    return [stretch for number, stretch in enumerate(stretches) if number in chosen]


def attribution_csv(clips: Sequence[ClipEntry], subjects: set[str]) -> str:
    """The clips that were fitted to, with licence and source, as CSV."""
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(_ATTRIBUTION_COLUMNS)
    for clip in clips:
        if clip.subject in subjects and clip.sequences:
            table.writerow([clip.video, clip.subject, clip.licence, clip.source])
    return stream.getvalue()


def _is_fitted(folder: Path) -> bool:
    path = folder / "config.json"
    return path.exists() and read_json(path).get("model") == RESIDUAL


def _is_begun(path: Path) -> bool:
    """Return whether a file is one that `fit` writes before ``config.json``, which is the last."""
    if path.name == ATTRIBUTION_FILE:
        start = ",".join(_ATTRIBUTION_COLUMNS).encode()
        return path.is_file() and path.read_bytes().startswith(start)
    return path.name in (BASELINES_FILE, "model.safetensors") and holds_residual(path)


WEIGHTS = FolderKind("weights of face-prediction fit", _is_fitted, begun=_is_begun)
