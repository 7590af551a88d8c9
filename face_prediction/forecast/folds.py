"""Groups of subjects, so that a choice is made on people it was not fitted to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def subject_folds(subjects: Sequence[str], folds: int) -> NDArray[np.int64]:
    """Fold (N,) of each sequence: all of one subject in one fold, the folds about equally large.

    The subject with most sequences goes first, each into the smallest fold; equal ones by name,
    so that the same subjects give the same folds. There are never more folds than subjects.
    """
    amounts = sorted(Counter(subjects).items(), key=lambda item: (-item[1], item[0]))
    sizes = [0] * min(folds, len(amounts))
    fold_of: dict[str, int] = {}
    for subject, amount in amounts:
        fold_of[subject] = sizes.index(min(sizes))
        sizes[fold_of[subject]] += amount
    return np.array([fold_of[subject] for subject in subjects], dtype=np.int64)
