"""Who forecasts what: rows of the tables, every fold of people by a predictor of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from face_prediction.cross_fit import CrossFit, Fitted, fit_baselines
from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError
from face_prediction.predictor import Predictor

#: baseline: fitted here. network: trained before. reference: no forecast at all, but what a
#: forecast is compared with.
Role = Literal["baseline", "network", "reference"]

#: What skill is measured against; its pictures are copies of the last one.
PERSISTENCE = "persistence"


class TrainedPredictor(Predictor, Protocol):
    """A network, and who it was trained on."""

    @property
    def test_fold(self) -> int:
        """The fold of people that it may be judged on."""
        ...

    @property
    def train_subjects(self) -> tuple[str, ...]:
        """Whom it was trained on."""
        ...

    @property
    def preset(self) -> str:
        """Its size."""
        ...


@dataclass(frozen=True)
class Contestant:
    """A row of the tables: a predictor fitted several times, each without the people of a fold."""

    fit: CrossFit
    role: Role

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.fit.name

    @property
    def folds(self) -> tuple[int, ...]:
        """Those that it can be judged on."""
        return tuple(sorted(self.fit.by_fold))


def networks(trained: Sequence[tuple[Path, TrainedPredictor]]) -> list[Contestant]:
    """Trained networks, those of one name and preset as one contestant.

    The preset is part of a contestant's name where there are several of the network's name.

    Raises:
        RequestError: two are of the same name, preset and fold.
    """
    groups: dict[tuple[str, str], dict[int, tuple[Path, TrainedPredictor]]] = {}
    for folder, predictor in trained:
        group = groups.setdefault((predictor.name, predictor.preset), {})
        first, _ = group.setdefault(predictor.test_fold, (folder, predictor))
        if first != folder:
            raise RequestError(
                f"{first} and {folder} are both {predictor.name} ({predictor.preset}) for fold "
                f"{predictor.test_fold}; evaluate them one after the other"
            )
    names = [name for name, _ in groups]
    result: list[Contestant] = []
    for (name, preset), group in groups.items():
        by_fold = {
            fold: Fitted(predictor, frozenset(predictor.train_subjects))
            for fold, (_, predictor) in sorted(group.items())
        }
        label = name if names.count(name) == 1 else f"{name} ({preset})"
        result.append(Contestant(CrossFit(label, by_fold), "network"))
    return result


def common_folds(contestants: Sequence[Contestant]) -> tuple[int, ...]:
    """The folds that all contestants cover: rows are compared on the same sequences.

    Raises:
        RequestError: there is none.
    """
    covered = [set(contestant.folds) for contestant in contestants]
    common = sorted(set.intersection(*covered)) if covered else []
    if not common:
        given = "; ".join(f"{c.name}: {', '.join(map(str, c.folds))}" for c in contestants)
        raise RequestError(
            f"no fold is covered by all checkpoints ({given}); train them with the same --test_fold"
        )
    return tuple(common)


def require_unseen(dataset: FaceDataset, contestants: Sequence[Contestant]) -> None:
    """Check before anything is forecast that nobody meets a predictor that knows the person.

    Raises:
        RequestError: a contestant is for a fold that is not there, or learnt from somebody in it.
    """
    folds = dataset.manifest.folds
    for contestant in contestants:
        strange = [fold for fold in contestant.folds if fold not in range(folds)]
        if strange:
            raise RequestError(
                f"{contestant.name} is for fold {strange[0]}; {dataset.folder} has folds 0 to "
                f"{folds - 1}"
            )
        for clip in dataset.manifest.clips:
            if clip.sequences and clip.fold in contestant.fit.by_fold:
                contestant.fit.of(clip.fold, clip.subject)


def baselines(dataset: FaceDataset, names: Sequence[str], folds: Sequence[int]) -> list[Contestant]:
    """Each baseline, fitted for each of ``folds`` to the people of all the others.

    Persistence is always among them, and first.

    Raises:
        RequestError: there is no forecaster of a name, or nobody in other folds to fit it to.
    """
    wanted = [PERSISTENCE, *(name for name in dict.fromkeys(names) if name != PERSISTENCE)]
    fits = fit_baselines(dataset, wanted, folds)
    return [Contestant(fits[name], "baseline") for name in wanted]
