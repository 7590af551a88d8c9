"""Experts of residual prediction: linear forecasters of a face's motion, and their features.

A face is a series of D = 2 + K numbers a frame: the mouth centre (u, v) and the coefficients of K
principal shapes of all landmarks. An expert forecasts its displacements 1 ... H frames ahead from
the last displacements, and from the place of the face relative to slow means of it. A moving face
comes back: what lies a second ahead is told by the place more than by the last step.

Shapes: N faces or rows, W recent frames, M slow means, D series, F features, H horizons.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

SHAPES = 8
"""K: principal shapes; a rigid head that moves parallel to the image has two."""
SERIES = 2 + SHAPES
"""D."""
RECENT = 9
"""W: frames that features are made from beside the slow means."""
SLOW = (10.0, 40.0, 150.0)
"""Time constants of the slow means in frames: a third of a second, 1.3 s, 5 s."""


@dataclass(frozen=True)
class LinearExpert:
    """A forecaster that is linear in its features.

    Attributes:
        shapes: principal shapes that it sees, the first ones; 0: the mouth centre instead.
        lags: displacements of each.
        places: number of slow means, the first of `SLOW`, that it sees the place relative to.
        adapts: whether it keeps learning from the face it watches.
        memory: frames after which what it has learnt counts 1 / e.
        calm: whether people who hardly move count as much as the others in its coefficients, of
            which the sum of all errors takes no notice.
        iterated: whether it forecasts one frame, and from that the next, as the baseline
            `ar_landmarks` does; it does not adapt and sees no places.
    """

    shapes: int
    lags: int
    places: int
    adapts: bool = True
    memory: float = 200.0
    calm: bool = False
    iterated: bool = False

    @property
    def columns(self) -> list[int]:
        """Columns of the series that it sees."""
        return list(range(2, 2 + self.shapes)) if self.shapes else [0, 1]

    @property
    def size(self) -> int:
        """F."""
        return len(self.columns) * (self.lags + self.places)


@dataclass(frozen=True)
class Extrapolation:
    """The last velocity continues, and dies away.

    Attributes:
        window: frames of the velocity.
        damping: of the velocity from frame to frame; 0: the face stands still.
        acceleration: damping from frame to frame of the last change of velocity; 0: none.
    """

    window: int
    damping: float
    acceleration: float = 0.0


Expert = LinearExpert | Extrapolation

EXPERTS: tuple[Expert, ...] = (
    LinearExpert(4, 2, 0, adapts=False),
    LinearExpert(4, 3, 0, adapts=False, calm=True),
    LinearExpert(4, 1, 0, adapts=False, iterated=True),
    LinearExpert(8, 3, 3),
    LinearExpert(4, 6, 3),
    LinearExpert(0, 4, 3),
    LinearExpert(4, 2, 3),
    Extrapolation(1, 0.0),
    Extrapolation(1, 1.0),
    Extrapolation(1, 0.8),
)
"""Chosen on folds of the development clips; docs/predictors.md has what each is worth."""


def linear_features(expert: LinearExpert, recent: Floats, slow: Floats) -> Floats:
    """Features (N, F) of recent frames (N, W, D), the newest last, and slow means (N, M, D)."""
    seen = recent[..., expert.columns]
    steps = np.diff(seen[:, -expert.lags - 1 :], axis=1)
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


def recent_frames(series: Floats) -> Floats:
    """The last frames (T, W, D) at every frame of a track (T, D), which began at rest."""
    padded = np.concatenate([np.repeat(series[:1], RECENT - 1, axis=0), series])
    return np.lib.stride_tricks.sliding_window_view(padded, RECENT, axis=0).swapaxes(1, 2)


def extrapolate(expert: Extrapolation, recent: Floats, horizons: NDArray[np.int64]) -> Floats:
    """Displacements (N, H, D) at ``horizons`` (H,) after recent frames (N, W, D)."""
    steps = np.diff(recent, axis=1)
    velocity = steps[:, -expert.window :].mean(axis=1)
    result = _power_sums(expert.damping, horizons)[:, None] * velocity[:, None]
    if expert.acceleration:
        change = steps[:, -1] - steps[:, -2]
        gained = np.cumsum(_power_sums(expert.acceleration, np.arange(1, horizons[-1] + 1)))
        result = result + gained[horizons - 1, None] * change[:, None]
    return result


def _power_sums(base: float, counts: NDArray[np.int64]) -> Floats:
    """The sum of base^1 ... base^n for each n of ``counts`` (H,)."""
    powers = np.cumsum(float(base) ** np.arange(1, int(counts[-1]) + 1))
    return powers[counts - 1]
