"""Who is trained on, who is looked at meanwhile, and who is left for the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError
from face_prediction.training.seeds import generator

HoldOut = Literal["next", "none"]


@dataclass(frozen=True)
class People:
    """The sequences to train on and to validate on; never one person in both."""

    #: (N,) sequences of the dataset
    train: NDArray[np.int64]
    #: none: nobody is held out
    validation: NDArray[np.int64]
    #: folds by use
    folds: dict[str, list[int]]
    train_subjects: list[str]


def choose_people(
    dataset: FaceDataset,
    *,
    test_fold: int | None,
    hold_out: HoldOut,
    subjects: int | None,
    seed: int,
) -> People:
    """Divide the dataset.

    Args:
        dataset: with its folds.
        test_fold: left out of everything; None: no fold is (for weights that are to be shipped).
        hold_out: ``next``: the fold after it validates; ``none``: all others train.
        subjects: train on the first so many people of an order drawn from ``seed``; None: on all.
        seed: of the run.

    Raises:
        RequestError: there is no such fold, nobody to train on, or fewer subjects.
    """
    if test_fold is None and hold_out == "next":
        raise RequestError("--test_fold None trains on everybody; say --hold_out none with it")
    count = dataset.manifest.folds
    test: tuple[int, ...] = ()
    train, validation = tuple(range(count)), ()
    if test_fold is not None:
        split = dataset.split(test_fold)
        train, validation, test = split.train, split.validation, split.test
        if hold_out == "none":
            train, validation = tuple(sorted({*train, *validation})), ()
        elif not validation:
            raise RequestError(
                f"{dataset.folder}: {count} folds leave none to hold out; say --hold_out none"
            )
    rows = dataset.indices(folds=train)
    owners = [dataset.entry(int(row)).subject for row in rows]
    names = sorted(set(owners))
    if not names:
        raise RequestError(f"{dataset.folder}: nobody to train on in folds {list(train)}")
    if subjects is not None:
        if not 1 <= subjects <= len(names):
            raise RequestError(f"--subjects {subjects}: the folds to train on have {len(names)}")
        order = generator(seed, "subjects").permutation(len(names))
        names = sorted(names[place] for place in order[:subjects])
        rows = rows[[owner in names for owner in owners]]
    return People(
        train=rows,
        validation=dataset.indices(folds=validation),
        folds={"train": list(train), "validation": list(validation), "test": list(test)},
        train_subjects=names,
    )
