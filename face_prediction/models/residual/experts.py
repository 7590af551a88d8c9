"""Experts of residual prediction: linear forecasters of a face's motion, and their features.

A face is a series of D = 2 + K numbers a frame: the mouth centre (u, v) and the coefficients of K
principal shapes of all landmarks. An expert forecasts its displacements 1 ... H frames ahead from
the last displacements, and from the place of the face relative to slow means of it. A moving face
comes back: the place predicts what lies a second ahead better than the last step.

Shapes: N faces or rows, W recent frames, M slow means, D series, F features, H horizons.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

SHAPES = 8
"""K: principal shapes; a rigid head that moves parallel to the image has two."""
SERIES = 2 + SHAPES
"""D."""
SLOW = (10.0, 40.0)
"""Time constants of the slow means in frames: a third of a second, and 1.3 s."""


@dataclass(frozen=True)
class LinearExpert:
    """A forecaster that is linear in its features.

    Attributes:
        shapes: principal shapes that it sees, the first ones; 0: the mouth centre instead.
        lags: displacements of each.
        places: number of slow means, the first of `SLOW`, that it sees the place relative to.
        iterated: whether it forecasts one frame, and from that the next, as the baseline
            `ar_landmarks` does. Such an expert sees no places and does not adapt; the others keep
            learning from the face that they watch.
        differences: whether its lags are differences of increasing order instead: the last
            displacement, how much larger it is than the one before, and so on. Where nothing
            jitters the displacements are nearly alike, and a fit cannot tell them apart.
    """

    shapes: int
    lags: int
    places: int
    iterated: bool = False
    differences: bool = False

    @property
    def columns(self) -> list[int]:
        """Columns of the series that it sees."""
        return list(range(2, 2 + self.shapes)) if self.shapes else [0, 1]

    @property
    def size(self) -> int:
        """F."""
        return len(self.columns) * (self.lags + self.places)


EXPERTS = (
    LinearExpert(4, 1, 0, iterated=True),
    LinearExpert(8, 3, 2),
    LinearExpert(8, 4, 1),
    LinearExpert(0, 4, 2),
)
"""Chosen on folds of the development clips; docs/predictors.md has what each is worth."""


def frames_needed(experts: Iterable[LinearExpert]) -> int:
    """Return W, the recent frames whose displacements the experts see."""
    return max(expert.lags for expert in experts) + 1


def linear_features(expert: LinearExpert, recent: Floats, slow: Floats) -> Floats:
    """Features (N, F) of recent frames (N, W, D), the newest last, and slow means (N, M, D)."""
    seen = recent[..., expert.columns]
    steps = np.diff(seen[:, -expert.lags - 1 :], axis=1)
    if expert.differences:
        orders = [steps[:, -1]]
        for _ in range(1, expert.lags):
            steps = steps[:, 1:] - steps[:, :-1]
            orders.append(steps[:, -1])
        steps = np.stack(orders, axis=1)
    place = seen[:, -1:] - slow[:, : expert.places, expert.columns]
    return np.concatenate([steps, place], axis=1).reshape(len(recent), -1)


def slow_rates(seen: int) -> Floats:
    """Share (M,) that the next frame has in each slow mean, after ``seen`` frames."""
    return np.maximum(1 / np.array(SLOW), 1 / (seen + 1))


def slow_means(series: Floats) -> Floats:
    """The slow means (T, M, D) at every frame of a track (T, D)."""
    means = np.empty((len(series), len(SLOW), series.shape[1]))
    mean = np.repeat(series[:1], len(SLOW), axis=0)
    for frame, row in enumerate(series):
        mean = mean + slow_rates(frame)[:, None] * (row - mean)
        means[frame] = mean
    return means


def recent_frames(series: Floats, count: int) -> Floats:
    """The last ``count`` frames (T, W, D) at every frame of a track (T, D), which began at rest."""
    padded = np.concatenate([np.repeat(series[:1], count - 1, axis=0), series])
    return np.lib.stride_tricks.sliding_window_view(padded, count, axis=0).swapaxes(1, 2)
