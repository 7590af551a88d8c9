"""Setup of an evaluation: sequences, predictors side by side, and the record of both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.image_batches import SequenceBatch, reduction
from face_prediction.dataset.manifest import SequenceRow
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import DatasetSplit, split_dataset
from face_prediction.evaluation.predictors import (
    BaselinePredictor,
    EvaluatedPredictor,
    FittedPredictor,
)
from face_prediction.tracking.detector import FaceDetector
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.seeds import stream_generator
from robo_manip_baselines.runs.versions import software_versions

PERSISTENCE = "persistence"
"""The baseline that skill is measured against; its images are copies of the last one."""
DEPENDS = ("numpy", "scipy", "scikit-image", "torch", "mediapipe", "opencv-python-headless", "h5py")
"""Packages that the numbers may depend on."""


@dataclass(frozen=True)
class SequenceSelection:
    """N sequences of a dataset, in its order.

    Attributes:
        indices: (N,) their numbers in the dataset.
        rows: N each: clip, subject, kind of footage, fold, first frame in the clip.
    """

    indices: NDArray[np.int64]
    rows: tuple[SequenceRow, ...]

    def __len__(self) -> int:
        return len(self.indices)

    def of_kind(self, kind: str) -> NDArray[np.intp]:
        """Places in this selection of the sequences of one kind of footage."""
        return np.flatnonzero([row.kind == kind for row in self.rows])

    def rows_at(self, places: NDArray[np.integer]) -> list[SequenceRow]:
        """The rows at some places."""
        return [self.rows[place] for place in places.tolist()]

    def batches(self, size: int) -> list[NDArray[np.intp]]:
        """Places of sequences to forecast at once: ``size`` or fewer of one fold."""
        folds = np.array([row.fold for row in self.rows])
        of_folds = [np.flatnonzero(folds == fold) for fold in np.unique(folds)]
        return [places[i : i + size] for places in of_folds for i in range(0, len(places), size)]


def select_sequences(
    dataset: FaceDataset,
    folds: Collection[int],
    kinds: Collection[str],
    max_sequences: int | None = None,
    seed: int = 0,
    split: DatasetSplit | None = None,
) -> SequenceSelection:
    """The sequences of these folds and kinds, of each kind at most ``max_sequences``.

    Where there are more, so many are drawn at random from ``seed``. With ``split`` folds are its
    parts, and ``fold`` of the rows is the part.

    Raises:
        RequestError: there are none.
    """
    split = split or split_dataset(dataset)
    rng = stream_generator(seed, "sequences")
    parts = [np.empty(0, dtype=np.int64)]
    for kind in kinds:
        found = np.intersect1d(split.members(folds), dataset.indices(kinds=(kind,)))
        if max_sequences is not None and len(found) > max_sequences:
            found = np.sort(rng.choice(found, max_sequences, replace=False))
        parts.append(found)
    indices = np.sort(np.concatenate(parts))
    if not len(indices):
        raise RequestError(
            f"{dataset.folder}: no sequence of kind {', '.join(kinds)} in fold "
            f"{', '.join(map(str, sorted(folds)))}"
        )
    rows = dataset.rows()
    chosen = (replace(rows[i], fold=int(split.part[i])) for i in indices.tolist())
    return SequenceSelection(indices, tuple(chosen))


def shuffled_partners(
    kinds: Sequence[str], subjects: Sequence[str], seed: int
) -> NDArray[np.int64]:
    """For each of N sequences (N,) the place of the one whose images stand in for its own.

    A permutation within each kind of footage that leaves none its own; every one gets another
    person's, too, unless one person has more than half of that kind.

    Raises:
        RequestError: there is only one sequence of a kind.
    """
    rng = stream_generator(seed, "exchange")
    result = np.empty(len(kinds), dtype=np.int64)
    for kind in dict.fromkeys(kinds):
        places = np.flatnonzero(np.array(kinds) == kind)
        if len(places) < 2:
            raise RequestError(
                f"{kind}: one sequence, so there is none to exchange images with; "
                "leave the kind out (--kinds), or give more sequences"
            )
        # people side by side, in random order: a step of the largest one's length leaves everybody
        names = [subjects[place] for place in places.tolist()]
        amounts = Counter(names)
        turn = dict(zip(sorted(amounts), rng.permutation(len(amounts)).tolist(), strict=True))
        drawn = rng.permutation(len(places)).tolist()
        order = places[np.array(sorted(drawn, key=lambda i: turn[names[i]]), dtype=np.int64)]
        step = max(amounts.values()) % len(places) or 1
        result[order] = np.roll(order, -step)
    return result


def common_folds(predictors: Sequence[EvaluatedPredictor]) -> tuple[int, ...]:
    """The folds that all predictors cover: rows are compared on the same sequences.

    Raises:
        RequestError: there is none.
    """
    common = set.intersection(*(set(predictor.by_fold) for predictor in predictors))
    if not common:
        given = "; ".join(f"{p.name}: {', '.join(map(str, p.by_fold))}" for p in predictors)
        raise RequestError(
            f"no fold is covered by all checkpoints ({given}); train them with the same --test_fold"
        )
    return tuple(sorted(common))


def require_unseen(
    dataset: FaceDataset, split: DatasetSplit, predictors: Sequence[EvaluatedPredictor]
) -> None:
    """Check before anything is forecast that nobody meets a predictor that knows the person.

    Raises:
        RequestError: a predictor is for a fold that is not there, or learnt from somebody in it.
    """
    last = split.parts - 1
    owners = [clip.subject for clip in dataset.manifest.clips]
    met = sorted(
        {(p, owners[c]) for p, c in zip(split.part.tolist(), split.clip.tolist(), strict=True)}
    )
    for predictor in predictors:
        for fold in predictor.by_fold:
            if not 0 <= fold <= last:
                raise RequestError(
                    f"{predictor.name} is for fold {fold}; {dataset.folder} has folds 0 to {last}"
                )
        for part, subject in met:
            if part in predictor.by_fold:
                predictor.predictor_for(part, subject)


@dataclass(frozen=True)
class EvaluationSetup:
    """Predictors that are ready to be scored side by side.

    Attributes:
        dataset: open.
        selection: the sequences.
        predictors: one row of the tables each.
        common_size: side at which all images are compared: the smallest that a predictor makes.
        detector: finds the face in images of those that forecast no landmarks; None: not needed.
        detected_size: the largest side of those images.
    """

    dataset: FaceDataset
    selection: SequenceSelection
    predictors: tuple[EvaluatedPredictor, ...]
    common_size: int
    detector: FaceDetector | None = None
    detected_size: int = 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sides at which there are images to compare."""
        return tuple(sorted({p.image_size for p in self.predictors} - {0}))

    @property
    def image_networks(self) -> list[EvaluatedPredictor]:
        """The networks that look at images."""
        networks = (predictor for predictor in self.predictors if predictor.role == "network")
        return [network for network in networks if any(needs.frames for needs in network.needs)]


def prepare_evaluation(
    dataset: FaceDataset,
    selection: SequenceSelection,
    predictors: Sequence[EvaluatedPredictor],
    open_detector: Callable[[], FaceDetector],
) -> EvaluationSetup:
    """Find out from one sequence what each predictor forecasts.

    Persistence is given images to copy, and predictors without landmarks the detector.

    Raises:
        RequestError: a predictor does not suit the dataset, or a detector is needed and there is
            none.
    """
    crop_size = dataset.manifest.settings.crop_size
    sizes: dict[str, int] = {}
    without_landmarks: set[str] = set()
    for predictor in predictors:
        batch = SequenceBatch(dataset, [int(selection.indices[0])], predictor.needs)
        forecast = predictor.forecast(selection.rows[:1], batch)
        if forecast.images is not None:
            sizes[predictor.name] = forecast.images.shape[2]
            reduction(crop_size, sizes[predictor.name])
            if np.isnan(forecast.landmarks).all():
                without_landmarks.add(predictor.name)
    common_size = sizes[PERSISTENCE] = min(sizes.values(), default=crop_size)
    detector = open_detector() if without_landmarks else None
    ready: list[EvaluatedPredictor] = []
    for row in predictors:
        by_fold = dict(row.by_fold)
        for fold, fitted in by_fold.items():
            if row.name == PERSISTENCE and isinstance(fitted.predictor, BaselinePredictor):
                copying = BaselinePredictor(fitted.predictor.forecaster, common_size)
                by_fold[fold] = replace(fitted, predictor=copying)
        finder = detector if row.name in without_landmarks else None
        size = sizes.get(row.name, 0)
        ready.append(replace(row, by_fold=by_fold, image_size=size, detector=finder))
    largest = max((sizes[name] for name in without_landmarks), default=0)
    return EvaluationSetup(dataset, selection, tuple(ready), common_size, detector, largest)


def provenance(
    dataset: FaceDataset,
    dataset_sha256: str,
    split: DatasetSplit,
    loaded: Sequence[FittedPredictor],
    options: Mapping[str, Any],
) -> dict[str, Any]:
    """The part of ``results.json`` that names dataset, split, checkpoints, options, versions."""
    versions = software_versions()
    for name in DEPENDS:
        with suppress(PackageNotFoundError):  # some are needed by some predictors only
            versions |= software_versions(name)
    return {
        "dataset": {
            "sha256": dataset_sha256,
            "folds": dataset.manifest.folds,
            "sequences": len(dataset),
            "settings": dataset.manifest.settings.to_json(),
        },
        "split": {
            "by": split.by,
            "parts": split.parts,
            "seed": split.seed,
            "windows_sha256": split.windows_sha256,
        },
        "checkpoints": [fitted.checkpoint for fitted in loaded],
        "options": dict(options),
        "versions": versions,
    }


def notes_on_selection(
    networks: Sequence[EvaluatedPredictor],
    folds: Sequence[int],
    split: DatasetSplit,
    max_sequences: int | None,
) -> list[str]:
    """Sentences for readers of the tables about what was left out."""
    result = []
    if len(folds) < split.parts:
        of = "the dataset's {} folds" if split.by == "person" else "{} parts of windows"
        result.append(f"{len(folds)} of {of.format(split.parts)} are reported on.")
    if split.by == "sequence":
        result.append("Whole tracks hold frames that were trained on, and are left out.")
    for network in networks:
        more = [str(fold) for fold in network.by_fold if fold not in folds]
        if more:
            also = f"{network.name} also has fold {', '.join(more)}"
            result.append(f"{also}, which not every network has; left out.")
    if max_sequences is not None:
        result.append(f"Of each kind at most {max_sequences} sequences, drawn at random.")
    return result
