"""Folds of people: nobody is in two of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from face_prediction.errors import RequestError

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
