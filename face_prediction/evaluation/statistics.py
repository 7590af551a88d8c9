"""Numbers of the tables, with bootstrap intervals over sequences that come in clusters, the people.

Sequences of one person resemble one another; resampling them as if they were independent makes
intervals too narrow. Here people are drawn with replacement, and then, for each draw of a person,
as many of the person's sequences as there are, with replacement (Davison and Hinkley 1997, 3.8;
``scipy.stats.bootstrap`` has no clusters).

Legend: W resamples, N sequences, R rows of the tables, H horizon, G groups of frames, K levels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.evaluation.predictors import Role
from face_prediction.evaluation.scoring import EvaluationScores, coverage
from face_prediction.evaluation.setup import PERSISTENCE
from face_prediction.prediction.errors import mouth_distances
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

GROUPS = ((1, 2), (3, 5))
"""Frames ahead (from, to) that differences are taken over: the near ones, where the last step says
most, and the far ones, where a model can gain."""
AVERAGED = ("distance", "nme", "ssim", "ssim_gain", "ssim_own_size", "ssim_copy_own_size")
"""Numbers that are plain means."""
_AT_ONCE = 200  # resamples that are worked on at once: a bound on memory


@dataclass(frozen=True)
class BootstrapEstimate:
    """A number, or an array of them, with the bounds of its percentile interval."""

    value: Floats
    low: Floats
    high: Floats


def bootstrap_mean(
    values: Floats,
    subjects: Sequence[str],
    *,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> BootstrapEstimate:
    """Mean of ``values`` (N, ...), NaN left out, with its interval over people and sequences.

    Args:
        values: one row a sequence. Models that are compared stand side by side in a row, so that
            every resample holds the same sequences of both.
        subjects: N names.
        level: share of resamples inside the interval.
        resamples: number of them, drawn from ``seed``.
        seed: of the resampling.

    Raises:
        RequestError: no rows, not one subject a row, or a level or number out of range.
    """
    if len(values) == 0 or len(values) != len(subjects):
        raise RequestError(f"{len(subjects)} subjects for {len(values)} sequences; one for each")
    if not 0 < level < 1:
        raise RequestError(f"level {level}; must be between 0 and 1")
    counts = resample_counts(subjects, resamples, seed)
    (mean,) = _mean(values, np.ones((1, len(values))))
    return BootstrapEstimate(mean, *_percentile_bounds(_mean(values, counts), level))


def resample_counts(subjects: Sequence[str], resamples: int, seed: int) -> Floats:
    """Number of times (W, N) that each sequence is in each of ``resamples``, drawn from ``seed``.

    Raises:
        RequestError: no rows, or a number out of range.
    """
    if not subjects:
        raise RequestError("no sequences to resample")
    if resamples < 1 or seed < 0:
        raise RequestError(f"{resamples} resamples with seed {seed}; 1 or more, and 0 or more")
    number = np.unique(np.asarray(subjects), return_inverse=True)[1]
    order, sizes = np.argsort(number, kind="stable"), np.bincount(number)
    first = np.cumsum(sizes) - sizes
    rng = np.random.default_rng(seed)
    counts = np.empty((resamples, len(subjects)))
    for resample in counts:
        people = rng.integers(len(sizes), size=len(sizes))
        drawn = sizes[people]  # sequences of each drawn person
        places = np.repeat(first[people], drawn) + rng.integers(np.repeat(drawn, drawn))
        resample[:] = np.bincount(order[places], minlength=len(subjects))
    return counts


@dataclass(frozen=True)
class RowSummary:
    """One row of the tables, beside its numbers: name and role of the predictor.

    Attributes:
        image_size: side of the images that it makes; 0: none.
        missing: (H,) frames without a forecast.
        has_intervals: it gives intervals.
    """

    name: str
    role: Role
    image_size: int
    missing: NDArray[np.int64]
    has_intervals: bool


@dataclass(frozen=True)
class KindSummary:
    """All numbers of one kind of footage.

    Attributes:
        kind: of footage.
        sequences: number of them, of so many ``subjects`` and ``clips``.
        common_size: side at which all images are compared.
        rows: R of them, the first axis of ``numbers``.
        best_baseline: the baseline with the least mean distance over the far frames.
        numbers: with the interval of each, of shapes (R, H, 2): ``mean`` and ``variance`` of the
            absolute errors; (R, H): ``distance`` of the mouth centre, ``nme``, ``ssim``,
            ``ssim_gain`` over persistence, ``ssim_own_size``, ``ssim_copy_own_size``, ``skill``
            against persistence; (R, H, K): ``coverage``; each of these over all frames, without
            the axis H, with ``pooled_`` before its name. ``difference`` (R, G) in percent of the
            best baseline, and ``shuffled_images`` (R, G + 1), with the images of other sequences,
            in percent of the row itself, by group and over all frames. NaN where there is none.
    """

    kind: str
    sequences: int
    subjects: int
    clips: int
    common_size: int
    rows: tuple[RowSummary, ...]
    best_baseline: str
    numbers: Mapping[str, BootstrapEstimate]

    @property
    def horizon(self) -> int:
        """H."""
        return len(self.rows[0].missing)


def summarise_kind(
    scores: EvaluationScores, kind: str, *, seed: int = 0, resamples: int = 2000
) -> KindSummary:
    """The numbers of one kind of footage; ``seed`` and number of ``resamples`` of the bootstrap.

    Raises:
        RequestError: there is no sequence of that kind, or too short a horizon.
    """
    places = scores.selection.of_kind(kind)
    if not len(places):
        raise RequestError("no sequence of this kind")
    horizon = scores.rows[0].residuals.shape[1]
    if horizon < GROUPS[1][0]:
        raise RequestError(
            f"a dataset with {horizon} frames to forecast; the tables need {GROUPS[1][0]} or more, "
            "build it with --future 5"
        )
    rows = scores.rows
    reference = [row.name for row in rows].index(PERSISTENCE)
    data = _columns(scores, places, reference)
    far = data["distance"][..., GROUPS[1][0] - 1 : GROUPS[1][1]].mean(axis=(0, 2))
    best = min((i for i, row in enumerate(rows) if row.role == "baseline"), key=lambda i: far[i])

    footage = scores.selection.rows_at(places)
    subjects = [row.subject for row in footage]
    counts = resample_counts(subjects, resamples, seed)
    whole = _numbers(data, np.ones((1, len(places))), reference, best)
    parts = [
        _numbers(data, counts[i : i + _AT_ONCE], reference, best)
        for i in range(0, resamples, _AT_ONCE)
    ]
    drawn = {name: np.concatenate([part[name] for part in parts]) for name in whole}
    return KindSummary(
        kind=kind,
        sequences=len(places),
        subjects=len(set(subjects)),
        clips=len({row.clip for row in footage}),
        common_size=scores.common_size,
        rows=tuple(
            RowSummary(
                row.name,
                row.role,
                row.image_size,
                missing=np.isnan(row.residuals[places]).any(axis=-1).sum(axis=0),
                has_intervals=bool(np.isfinite(row.levels[places]).any()),
            )
            for row in rows
        ),
        best_baseline=rows[best].name,
        numbers={
            name: BootstrapEstimate(value, *_percentile_bounds(drawn[name]))
            for name, (value,) in whole.items()
        },
    )


def _columns(
    scores: EvaluationScores, places: NDArray[np.intp], reference: int
) -> dict[str, Floats]:
    """Scores (N, R, H, ...) of the sequences at ``places``."""

    def stack(name: str) -> Floats:
        return np.stack([getattr(row, name)[places] for row in scores.rows], axis=1)

    residuals, ssim = stack("residuals"), stack("similarity")
    none = np.full_like(scores.rows[0].nme, np.nan)
    copies = [scores.copies.get(row.image_size, none)[places] for row in scores.rows]
    return {
        "absolute": np.abs(residuals),
        "distance": mouth_distances(residuals),
        "nme": stack("nme"),
        "ssim": ssim,
        "ssim_gain": ssim - ssim[:, [reference]],
        "ssim_own_size": stack("own_similarity"),
        "ssim_copy_own_size": np.stack(copies, axis=1),
        "coverage": coverage(stack("levels")),
        "shuffled_distance": mouth_distances(stack("shuffled_residuals")),
    }


def _numbers(
    data: Mapping[str, Floats], weight: Floats, reference: int, best: int
) -> dict[str, Floats]:
    """`KindSummary.numbers` (W, R, ...) of sequences that count ``weight`` (W, N) times each."""
    result: dict[str, Floats] = {}
    absolute, distance = data["absolute"], data["distance"]
    for prefix, frames in (("", None), ("pooled_", 2)):
        mean = _mean(absolute, weight, frames)
        square = _mean(absolute**2, weight, frames)
        result[f"{prefix}mean"] = mean
        result[f"{prefix}variance"] = np.maximum(square - mean**2, 0.0)
        for name in (*AVERAGED, "coverage"):
            result[f"{prefix}{name}"] = _mean(data[name], weight, frames)
    persistence, baseline = (
        np.broadcast_to(distance[:, [row]], distance.shape) for row in (reference, best)
    )
    result["skill"] = 1 - _ratio(distance, persistence, weight, None)
    result["pooled_skill"] = 1 - _ratio(distance, persistence, weight, 2)
    groups = [slice(first - 1, last) for first, last in GROUPS]
    for name, ours, theirs, spans in (
        ("difference", distance, baseline, groups),
        ("shuffled_images", data["shuffled_distance"], distance, [*groups, slice(None)]),
    ):
        ratios = [_ratio(ours[..., span], theirs[..., span], weight, 2) for span in spans]
        result[name] = 100 * (np.stack(ratios, axis=-1) - 1)
    return result


def _mean(values: Floats, weight: Floats, frames: int | None = None) -> Floats:
    """Weighted mean of (N, ...) over sequences, and axis ``frames`` if given; without NaN."""
    total, count = _sums(values, ~np.isnan(values), weight, frames)
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def _ratio(ours: Floats, theirs: Floats, weight: Floats, frames: int | None) -> Floats:
    """Sum of ours / sum of theirs, where both are; NaN where theirs is without error."""
    both = ~(np.isnan(ours) | np.isnan(theirs))
    mine, other = (_sums(values, both, weight, frames)[0] for values in (ours, theirs))
    return np.divide(mine, other, out=np.full_like(mine, np.nan), where=other > 0)


def _sums(
    values: NDArray[np.floating], known: NDArray[np.bool_], weight: Floats, frames: int | None
) -> tuple[Floats, Floats]:
    """Weighted sum and count (W, ...) of the ``known`` values."""
    total = np.where(known, values, 0.0)
    count = known.astype(np.float64)
    if frames is not None:
        total, count = total.sum(axis=frames), count.sum(axis=frames)
    return np.tensordot(weight, total, axes=1), np.tensordot(weight, count, axes=1)


def _percentile_bounds(drawn: Floats, level: float = 0.95) -> tuple[Floats, Floats]:
    """Lower and upper bounds (...) of the middle ``level`` of resampled statistics (W, ...).

    NaN where no resample has a number.
    """
    tail = (1 - level) / 2
    nothing = np.isnan(drawn).all(axis=0)
    bounds = np.nanquantile(np.where(nothing, 0.0, drawn), [tail, 1 - tail], axis=0)
    low, high = np.where(nothing, np.nan, bounds)
    return low, high
