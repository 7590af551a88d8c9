"""Which sequences are forecast, and whose pictures stand in for whose.

Legend: N sequences.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError


@dataclass(frozen=True)
class Selection:
    """N sequences of a dataset, in its order."""

    #: (N,) their numbers in the dataset
    indices: NDArray[np.int64]
    #: N each: whose face, of which clip, what kind of footage
    subjects: tuple[str, ...]
    clips: tuple[str, ...]
    kinds: tuple[str, ...]
    #: (N,) fold, and first frame in the clip
    folds: NDArray[np.int64]
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.indices)

    def of_kind(self, kind: str) -> NDArray[np.intp]:
        """Places in this selection of the sequences of one kind of footage."""
        return np.flatnonzero(np.array(self.kinds) == kind)


def select(
    dataset: FaceDataset,
    folds: Collection[int],
    kinds: Collection[str],
    max_sequences: int | None,
    seed: int,
) -> Selection:
    """The sequences of these folds and kinds, of each kind at most ``max_sequences``.

    Where there are more, so many are drawn at random from ``seed``.

    Raises:
        RequestError: there are none.
    """
    rng = np.random.default_rng([seed, *b"sequences"])
    parts: list[NDArray[np.int64]] = []
    for kind in kinds:
        found = dataset.indices(folds=folds, kinds=(kind,))
        if max_sequences is not None and len(found) > max_sequences:
            found = np.sort(rng.choice(found, max_sequences, replace=False))
        parts.append(found)
    indices = np.sort(np.concatenate([np.empty(0, dtype=np.int64), *parts]))
    if not len(indices):
        raise RequestError(
            f"{dataset.folder}: no sequence of kind {', '.join(kinds)} in fold "
            f"{', '.join(map(str, sorted(folds)))}"
        )
    table = dataset.rows()
    rows = [table[index] for index in indices.tolist()]
    return Selection(
        indices=indices,
        subjects=tuple(row.subject for row in rows),
        clips=tuple(row.clip for row in rows),
        kinds=tuple(row.kind for row in rows),
        folds=np.array([row.fold for row in rows], dtype=np.int64),
        starts=np.array([row.start for row in rows], dtype=np.int64),
    )


def exchange_pictures(
    kinds: Sequence[str], subjects: Sequence[str], seed: int
) -> NDArray[np.int64]:
    """For each of N sequences (N,) the place of the one whose pictures it is shown instead.

    A permutation within each kind of footage that leaves none its own; every one is shown another
    person's, too, unless one person has more than half of that kind.

    Raises:
        RequestError: there is only one sequence of a kind.
    """
    rng = np.random.default_rng([seed, *b"exchange"])
    result = np.empty(len(kinds), dtype=np.int64)
    for kind in dict.fromkeys(kinds):
        places = np.flatnonzero(np.array(kinds) == kind)
        if len(places) < 2:
            raise RequestError(
                f"{kind}: one sequence, so there is none to exchange pictures with; "
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
