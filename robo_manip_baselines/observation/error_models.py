"""Errors of the forecast for every video frame of an episode, drawn from measured statistics.

Legend: F video frames, H horizons, C = 2 H components in the order 1 U, 1 V, 2 U, ...; the last
axis of (F, H, 2) is U, V: metres right and down in the image.

Each function prepares what does not change from episode to episode, and returns what draws: a
partial function, which can be copied and pickled with its environment. Of F
frames the first are the same as if fewer were drawn: what is needed is taken from the generator
frame by frame. Adding an error is a function, a line in ``DRAWN_ERRORS`` and a name in
``corruption.MEASURED_ERRORS``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from robo_manip_baselines.observation.error_stats import ErrorStats
from robo_manip_baselines.observation.state import Floats
from robo_manip_baselines.runs.errors import RequestError

Draw = Callable[[np.random.Generator, int], Floats]
"""(generator, F) -> (F, H, 2) m."""

WORLD_FROM_IMAGE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
"""Rows: right and down in the image, in world axes. The face looks along +x and the camera at it,
along -x with z up, so that its right is +y. Depth, world x, is untouched."""

BLOCK_FRAMES = 60
"""Frames of measured errors that ``empirical`` plays before it jumps: 2 s, longer than errors
remember."""

_SLOWEST = 0.999
"""Largest correlation from frame to frame of ``gaussian``, so that it stays stationary."""


def uniform(stats: ErrorStats) -> Draw:
    """Draw every number independently within +-max of equations 6 and 7 (paper, section IV.C).

    The bound is the mean absolute error of that horizon and axis. So half of it is the mean
    absolute error of what is drawn, and a third of its square the variance. The paper does not say
    how long an error lasts: here it is that of one video frame, independent of the next and of
    other horizons.
    """
    return partial(_draw_uniform, stats.mean_abs)


def _draw_uniform(bound: Floats, rng: np.random.Generator, frames: int) -> Floats:
    return rng.uniform(-1.0, 1.0, (frames, *bound.shape)) * bound


def gaussian(stats: ErrorStats) -> Draw:
    """Draw from a stationary process with the file's bias, covariance and, as near as it can be,
    autocorrelation.

    On each principal axis of the covariance it is autoregressive of order 1; the coefficients are
    those between 0 and 1 whose mixture is nearest to the file's correlation one stride later.
    """
    variance, axes = np.linalg.eigh(stats.covariance)
    # Which of two directions an axis has is up to the linear-algebra library.
    axes = axes * np.where(axes[np.abs(axes).argmax(axis=0), np.arange(len(axes))] < 0, -1.0, 1.0)
    gain = axes * np.sqrt(np.maximum(variance, 0.0))  # (C, C): component from axis
    return partial(_draw_gaussian, stats.bias, gain, frame_persistence(stats, gain))


def _draw_gaussian(
    bias: Floats, gain: Floats, persistence: Floats, rng: np.random.Generator, frames: int
) -> Floats:
    fresh = np.sqrt(1.0 - persistence**2)
    drawn = rng.standard_normal((frames, len(persistence)))
    for frame in range(1, frames):
        drawn[frame] = persistence * drawn[frame - 1] + fresh * drawn[frame]
    # Not a matrix product, whose rounding may depend on the number of frames.
    mixed = (drawn[:, None, :] * gain).sum(axis=-1)
    return bias + mixed.reshape(frames, *bias.shape)


def frame_persistence(stats: ErrorStats, gain: Floats) -> Floats:
    """Return (C,) autoregressive coefficients from video frame to video frame."""
    if len(stats.autocorrelation) < 2:
        return np.zeros(len(gain))
    total = (gain**2).sum(axis=1)
    share = np.divide(gain**2, total[:, None], out=np.zeros_like(gain), where=total[:, None] > 0)
    # Components with more variance count for more.
    weight = np.sqrt(total / max(float(total.max()), np.finfo(float).tiny))
    wanted = stats.autocorrelation[1].ravel()
    from scipy.optimize import lsq_linear  # slow to import

    fit = lsq_linear(share * weight[:, None], wanted * weight, bounds=(0.0, 1.0))
    return np.minimum(np.maximum(fit.x, 0.0) ** (1.0 / stats.stride), _SLOWEST)


def empirical(stats: ErrorStats) -> Draw:
    """Play measured errors again, in blocks of ``BLOCK_FRAMES`` from anywhere (block bootstrap).

    A block that reaches the end of a run goes on at its beginning, so that every measured error is
    as likely as any other. Between forecasts that are ``stride`` frames apart it is interpolated,
    and the deviation from the mean scaled so that the variance is the same at every frame.

    Raises:
        RequestError: the file holds no runs.
    """
    if not stats.runs:
        raise RequestError(
            f"error statistics '{stats.source}' hold no residuals to play again; choose the error "
            "gaussian or uniform, or export the statistics with residuals"
        )
    length = -(-BLOCK_FRAMES // stats.stride)
    follow = _next_correlation(stats.runs) * (length - 1) / length  # none from block to block
    return partial(_draw_empirical, stats.runs, stats.stride, follow)


def _draw_empirical(
    runs: tuple[Floats, ...], stride: int, follow: Floats, rng: np.random.Generator, frames: int
) -> Floats:
    length = -(-BLOCK_FRAMES // stride)
    sizes = np.array([len(run) for run in runs])
    ends = np.cumsum(sizes)
    pool = np.concatenate(runs)
    mean = pool.mean(axis=0)
    blocks = -(-(-(-frames // stride) + 1) // length)
    place = rng.integers(ends[-1], size=blocks)
    run = np.searchsorted(ends, place, side="right")
    first = ends[run] - sizes[run]
    steps = (place - first)[:, None] + np.arange(length)
    known = (pool - mean)[(first[:, None] + steps % sizes[run][:, None]).ravel()]
    before, part = np.divmod(np.arange(frames), stride)
    late = (part / stride)[:, None, None]
    mixed = (1.0 - late) * known[before] + late * known[before + 1]
    kept = (1.0 - late) ** 2 + late**2 + 2.0 * late * (1.0 - late) * follow
    return mean + mixed / np.sqrt(np.maximum(kept, np.finfo(float).tiny))


def _next_correlation(runs: tuple[Floats, ...]) -> Floats:
    """(H, 2) correlation of an error with the next of its run, the first following on the last."""
    pool = np.concatenate(runs)
    mean = pool.mean(axis=0)
    products = sum(((run - mean) * (np.roll(run, -1, axis=0) - mean)).sum(axis=0) for run in runs)
    squares = ((pool - mean) ** 2).sum(axis=0)
    return np.divide(products, squares, out=np.zeros_like(squares), where=squares > 0)


DRAWN_ERRORS: dict[str, Callable[[ErrorStats], Draw]] = {
    "uniform": uniform,
    "gaussian": gaussian,
    "empirical": empirical,
}
