"""Predictors of people they never saw: one for every fold of a dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError
from face_prediction.evaluation.baseline_predictor import BaselinePredictor
from face_prediction.forecast import FORECASTERS, LandmarkSequences, fit_forecaster
from face_prediction.predictor import PictureNeeds, Predictor
from face_prediction.video import sha256_of

#: Bytes of pictures that are shown to a predictor at once.
_PICTURE_BYTES = 64 << 20
#: Histories at once where there are no pictures.
_LANDMARK_BATCH = 64


@dataclass(frozen=True)
class Fitted:
    """A predictor, everyone whose footage shaped it, and where it is kept, if anywhere."""

    predictor: Predictor
    subjects: frozenset[str]
    folder: Path | None = None


@dataclass(frozen=True)
class CrossFit:
    """One predictor fitted several times, each time without the people of one fold."""

    name: str
    by_fold: Mapping[int, Fitted]

    def of(self, fold: int | None, subject: str) -> Predictor:
        """The predictor for a person of ``fold``.

        Raises:
            RequestError: there is none for the fold, or it was fitted to this person.
        """
        if fold is None or fold not in self.by_fold:
            known = ", ".join(map(str, sorted(self.by_fold)))
            raise RequestError(
                f"{self.name}: subject '{subject}' is in no fold of the dataset; add their clips"
                if fold is None
                else f"{self.name}: subject '{subject}' is of fold {fold}, and only the folds "
                f"{known} are forecast; give a checkpoint with that test fold"
            )
        fitted = self.by_fold[fold]
        if subject in fitted.subjects:
            raise RequestError(
                f"{self.name}: what forecasts fold {fold} was trained on subject '{subject}', who "
                "is in that fold; train on the same dataset as is given here"
            )
        return fitted.predictor


def cross_fit(dataset: FaceDataset, checkpoints: Sequence[Path], baseline: str | None) -> CrossFit:
    """Networks from their folders, or one baseline fitted here; exactly one of both is given.

    Raises:
        RequestError: both or neither is given, or one of them cannot be used.
    """
    if bool(checkpoints) == (baseline is not None):
        raise RequestError(
            "give either --checkpoints (one folder for each fold) or --baseline "
            f"({', '.join(FORECASTERS)})"
        )
    if baseline is None:
        return load_networks(dataset, checkpoints)
    return fit_baselines(dataset, [baseline], folds_with_people(dataset))[baseline]


def load_networks(dataset: FaceDataset, folders: Sequence[Path]) -> CrossFit:
    """Trained networks of one kind, each of another test fold of ``dataset``.

    Raises:
        RequestError: a folder holds no checkpoint, one of another kind or of other data, or two
            have the same test fold.
    """
    from face_prediction.models.learned import LearnedPredictor  # PyTorch only where it is needed

    data = sha256_of(dataset.folder / MANIFEST_NAME)
    by_fold: dict[int, Fitted] = {}
    names: list[str] = []
    for folder in folders:
        network = LearnedPredictor.load(folder)
        record = network.record
        if record.dataset_sha256 != data:
            raise RequestError(
                f"{folder}: was trained on another dataset than {dataset.folder}, whose folds are "
                "others; give the one it was trained on"
            )
        names.append(network.name)
        if network.name != names[0]:
            raise RequestError(
                f"{folder}: is '{network.name}', {folders[0]} is '{names[0]}'; give checkpoints "
                "of one kind"
            )
        for fold in record.folds["test"]:
            if fold in by_fold:
                raise RequestError(
                    f"{folder}: test fold {fold}, as {by_fold[fold].folder}; give one checkpoint "
                    "for each fold"
                )
            by_fold[fold] = Fitted(network, frozenset(record.train_subjects), folder)
    return CrossFit(names[0], by_fold)


def fit_baselines(
    dataset: FaceDataset, names: Sequence[str], folds: Sequence[int]
) -> dict[str, CrossFit]:
    """Each baseline, fitted for each of ``folds`` to the people of all the others.

    Raises:
        RequestError: there is no forecaster of a name, or nobody in other folds to fit it to.
    """
    for name in names:
        if name not in FORECASTERS:
            raise RequestError(f"baseline '{name}'; there are {', '.join(FORECASTERS)}")
    by_fold: dict[str, dict[int, Fitted]] = {name: {} for name in names}
    # copies of u and v: a view would keep the depth in memory, too
    frames = [dataset.landmarks(index)[..., :2].copy() for index in range(len(dataset))]
    for fold in folds:
        others = set(range(dataset.manifest.folds)) - {fold}
        known = dataset.indices(folds=others).tolist()
        if not known:
            raise RequestError(
                f"{dataset.folder}: all its people are in fold {fold}, so nobody is left to fit "
                "the baselines to; build it with --folds 2 or more"
            )
        subjects = tuple(dataset.entry(index).subject for index in known)
        sequences = LandmarkSequences(np.stack([frames[index] for index in known]), subjects)
        for name in names:
            predictor = BaselinePredictor(fit_forecaster(name, sequences))
            by_fold[name][fold] = Fitted(predictor, frozenset(subjects))
    return {name: CrossFit(name, fitted) for name, fitted in by_fold.items()}


def folds_with_people(dataset: FaceDataset) -> list[int]:
    """The folds that there are sequences of."""
    clips = dataset.manifest.clips
    return sorted({clip.fold for clip in clips if clip.sequences and clip.fold is not None})


def batch_size(needs: PictureNeeds) -> int:
    """How many histories to forecast at once."""
    one = needs.frames * needs.size**2 * 3
    return _LANDMARK_BATCH if one == 0 else int(np.clip(_PICTURE_BYTES // one, 1, _LANDMARK_BATCH))
