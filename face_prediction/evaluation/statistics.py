"""Bootstrap intervals over sequences that come in clusters, one for each person.

Sequences of one person resemble one another; resampling them as if they were independent makes
intervals too narrow. Here people are drawn with replacement, and then, for each draw of a person,
as many of the person's sequences as there are, with replacement (Davison and Hinkley 1997, 3.8;
``scipy.stats.bootstrap`` has no clusters).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.evaluation.calibration import covered
from face_prediction.evaluation.errors import mouth_distances
from face_prediction.evaluation.scoring import Judged, Verdict
from face_prediction.evaluation.setup import PERSISTENCE, Role
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Interval:
    """An estimate with its percentile interval; arrays of the statistic's shape."""

    estimate: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    #: people: with one the interval says nothing of others, with a handful little
    clusters: int


def cluster_bootstrap(
    values: NDArray[np.floating],
    subjects: Sequence[str],
    statistic: Callable[[NDArray[np.floating]], NDArray[np.floating] | float] | None = None,
    *,
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Percentile interval of ``statistic`` over resampled people and sequences.

    Args:
        values: (N, ...) one row a sequence. Models that are compared stand side by side in a row,
            so that every resample holds the same sequences of both.
        subjects: N names.
        statistic: function of resampled rows; None: their mean, NaN left out.
        level: share of resamples inside the interval.
        resamples: how many.
        seed: of the resampling.

    Raises:
        RequestError: no rows, not one subject a row, or a level or number out of range.
    """
    if len(values) == 0 or len(values) != len(subjects):
        raise RequestError(f"{len(subjects)} subjects for {len(values)} sequences; one for each")
    if not 0 < level < 1:
        raise RequestError(f"level {level}; must be between 0 and 1")
    of_rows = _mean if statistic is None else statistic
    drawn = np.array(
        [of_rows(values[rows]) for rows in _draws(subjects, resamples, seed)], dtype=np.float64
    )
    low, high = percentile_bounds(drawn, level)
    estimate = np.asarray(of_rows(values), dtype=np.float64)
    return Interval(estimate, low, high, len(set(subjects)))


def resample_counts(
    subjects: Sequence[str], *, resamples: int = 2000, seed: int = 0
) -> NDArray[np.int64]:
    """How often (resamples, N) each sequence is in the resamples of `cluster_bootstrap`.

    For statistics that weights are enough for, all resamples at once.

    Args:
        subjects: N names.
        resamples: how many.
        seed: of the resampling.

    Raises:
        RequestError: no rows, or a number out of range.
    """
    if not subjects:
        raise RequestError("no sequences to resample")
    draws = _draws(subjects, resamples, seed)
    return np.stack([np.bincount(rows, minlength=len(subjects)) for rows in draws])


def percentile_bounds(
    drawn: NDArray[np.floating], level: float = 0.95
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper bounds (...) of the middle ``level`` of resampled statistics (W, ...).

    NaN where no resample has a number.
    """
    tail = (1 - level) / 2
    nothing = np.isnan(drawn).all(axis=0)
    bounds = np.nanquantile(np.where(nothing, 0.0, drawn), [tail, 1 - tail], axis=0)
    low, high = np.where(nothing, np.nan, bounds)
    return low, high


def _draws(subjects: Sequence[str], resamples: int, seed: int) -> Iterator[NDArray[np.intp]]:
    """Drawn rows, resample by resample."""
    if resamples < 1 or seed < 0:
        raise RequestError(f"{resamples} resamples with seed {seed}; 1 or more, and 0 or more")
    number = np.unique(np.asarray(subjects), return_inverse=True)[1]
    order, sizes = np.argsort(number, kind="stable"), np.bincount(number)
    rng = np.random.default_rng(seed)
    for _ in range(resamples):
        yield order[_resample(sizes, rng)]


def _resample(sizes: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.intp]:
    """Places of drawn sequences, where those of each person (``sizes``) lie side by side."""
    people = rng.integers(len(sizes), size=len(sizes))
    drawn = sizes[people]
    first = np.repeat((np.cumsum(sizes) - sizes)[people], drawn)
    return first + rng.integers(np.repeat(drawn, drawn))


def _mean(rows: NDArray[np.floating]) -> NDArray[np.float64]:
    there = ~np.isnan(rows)
    total = np.where(there, rows, 0.0).sum(axis=0, dtype=np.float64)
    count = there.sum(axis=0)
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)


Floats = NDArray[np.float64]

#: Frames ahead that differences are taken over: the near ones, where the last step says most, and
#: the far ones, where a model can gain; from, to.
GROUPS = ((1, 2), (3, 5))

#: Resamples that are worked on at once: a bound on memory.
_AT_ONCE = 200
#: What `measure` takes plain means of.
AVERAGED = ("distance", "nme", "ssim", "ssim_gain", "ssim_own_size", "ssim_copy_own_size")


@dataclass(frozen=True)
class Estimate:
    """A number, or an array of them, with the bounds of its interval."""

    value: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class KindSummary:
    """All numbers of one kind of footage."""

    kind: str
    sequences: int
    subjects: int
    clips: int
    #: R names and roles; the order of the first axis of ``numbers``
    rows: tuple[str, ...]
    roles: tuple[Role, ...]
    #: R sides of the pictures that each makes, 0: none; and the side all are compared at
    picture_sizes: tuple[int, ...]
    common_size: int
    #: (R, H) frames without a forecast
    missing: NDArray[np.int64]
    #: R: whether it gives intervals
    has_intervals: tuple[bool, ...]
    #: the baseline with the least mean distance over the far frames
    best_baseline: str
    #: see `measure`
    numbers: Mapping[str, Estimate]

    def place(self, name: str) -> int:
        """Where the row of that name is."""
        return self.rows.index(name)


def summarise(
    verdict: Verdict,
    kind: str,
    exchanged: Mapping[str, Floats] | None = None,
    *,
    seed: int = 0,
    resamples: int = 2000,
) -> KindSummary:
    """The numbers of one kind of footage.

    Args:
        verdict: how every row did on N sequences.
        kind: which of them count.
        exchanged: residuals (N, H, 2) of rows that were shown other sequences' pictures.
        seed: of the bootstrap.
        resamples: of the bootstrap.

    Raises:
        RequestError: there is no sequence of that kind, or too short a horizon.
    """
    places = verdict.selection.of_kind(kind)
    rows = verdict.rows
    subjects = [verdict.selection.subjects[place] for place in places]
    data = columns(verdict, places, exchanged or {})
    best = _best_baseline(rows, data["distance"])
    reference = _persistence(rows)

    whole = measure(data, np.ones((1, len(places))), reference, best)
    counts = resample_counts(subjects, resamples=resamples, seed=seed).astype(np.float64)
    parts = [
        measure(data, counts[i : i + _AT_ONCE], reference, best)
        for i in range(0, resamples, _AT_ONCE)
    ]
    numbers: dict[str, Estimate] = {}
    for name, (value,) in whole.items():
        drawn = np.concatenate([part[name] for part in parts])
        numbers[name] = Estimate(value, *percentile_bounds(drawn))
    return KindSummary(
        kind=kind,
        sequences=len(places),
        subjects=len(set(subjects)),
        clips=len({verdict.selection.clips[place] for place in places}),
        rows=tuple(row.name for row in rows),
        roles=tuple(row.role for row in rows),
        picture_sizes=tuple(row.picture_size for row in rows),
        common_size=verdict.common_size,
        missing=np.isnan(data["distance"]).sum(axis=0),
        has_intervals=tuple(bool(np.isfinite(row.levels[places]).any()) for row in rows),
        best_baseline=rows[best].name,
        numbers=numbers,
    )


def columns(
    verdict: Verdict, places: NDArray[np.intp], exchanged: Mapping[str, Floats]
) -> dict[str, Floats]:
    """What `measure` takes, (N, R, H, ...) each, of the sequences at ``places``."""
    rows = verdict.rows
    if not len(places):
        raise RequestError("no sequence of this kind")
    horizon = rows[0].residuals.shape[1]
    if horizon < GROUPS[1][0]:
        raise RequestError(
            f"a dataset with {horizon} frames to forecast; the tables need {GROUPS[1][0]} or more, "
            "build it with --future 5"
        )

    def stack(values: Sequence[Floats]) -> Floats:
        return np.stack([value[places] for value in values], axis=1)

    residuals = stack([row.residuals for row in rows])
    nothing = np.full_like(rows[0].residuals, np.nan)
    blank = nothing[..., 0]
    ssim = stack([row.similarity for row in rows])
    own = [row.picture_size if row.picture_size in verdict.copies else 0 for row in rows]
    return {
        "absolute": np.abs(residuals),
        "distance": mouth_distances(residuals),
        "nme": stack([row.nme for row in rows]),
        "ssim": ssim,
        "ssim_gain": ssim - ssim[:, [_persistence(rows)]],
        "ssim_own_size": stack([row.own_similarity for row in rows]),
        "ssim_copy_own_size": stack([verdict.copies.get(size, blank) for size in own]),
        "covered": covered(stack([row.levels for row in rows])),
        "exchanged": mouth_distances(stack([exchanged.get(row.name, nothing) for row in rows])),
    }


def measure(
    data: Mapping[str, Floats], weight: Floats, reference: int, best: int
) -> dict[str, Floats]:
    """Every number of the tables, of sequences that count ``weight`` (W, N) times each.

    Returns:
        With W before each shape: ``mean``, ``variance`` (R, H, 2) of the absolute errors,
        ``pooled_mean`` and ``pooled_variance`` (R, 2) over all frames. By frame (R, H) and pooled
        (R,): ``distance`` of the mouth centre, ``nme``, ``ssim``, ``ssim_gain`` over row
        ``reference``, ``ssim_own_size``, ``ssim_copy_own_size``, and ``skill`` against row
        ``reference``; with K levels more, ``coverage``. ``difference`` (R, G) in percent of row
        ``best``, and ``exchanged`` (R, G + 1) in percent of the row itself, by group and over all
        frames. NaN where there is nothing to say.
    """
    result: dict[str, Floats] = {}
    absolute = data["absolute"]
    for prefix, frames in (("", None), ("pooled_", 2)):
        mean = _mean_summary(absolute, weight, frames)
        square = _mean_summary(absolute**2, weight, frames)
        result[f"{prefix}mean"] = mean
        result[f"{prefix}variance"] = np.maximum(square - mean**2, 0.0)
        for name in AVERAGED:
            result[f"{prefix}{name}"] = _mean_summary(data[name], weight, frames)
        result[f"{prefix}coverage"] = _mean_summary(data["covered"], weight, frames)
    distance = data["distance"]
    persistence = np.broadcast_to(distance[:, [reference]], distance.shape)
    result["skill"] = 1 - _ratio(distance, persistence, weight, None)
    result["pooled_skill"] = 1 - _ratio(distance, persistence, weight, 2)
    baseline = np.broadcast_to(distance[:, [best]], distance.shape)
    spans = [slice(first - 1, last) for first, last in GROUPS]
    result["difference"] = _percent(
        [_ratio(distance[..., s], baseline[..., s], weight, 2) for s in spans]
    )
    shown = data["exchanged"]
    result["exchanged"] = _percent(
        [_ratio(shown[..., s], distance[..., s], weight, 2) for s in (*spans, slice(None))]
    )
    return result


def _percent(ratios: Sequence[Floats]) -> Floats:
    """How far (W, R, G) each of G ratios (W, R) is above 1, in percent."""
    return 100 * (np.stack(ratios, axis=-1) - 1)


def _mean_summary(values: Floats, weight: Floats, frames: int | None) -> Floats:
    """Weighted mean of (N, R, H, ...) over sequences, and axis ``frames`` if given; without NaN."""
    total, count = _sums(values, ~np.isnan(values), weight, frames)
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def _ratio(ours: Floats, theirs: Floats, weight: Floats, frames: int | None) -> Floats:
    """Sum of ours / sum of theirs, where both are; NaN where theirs is without error."""
    both = ~(np.isnan(ours) | np.isnan(theirs))
    mine, _ = _sums(ours, both, weight, frames)
    other, _ = _sums(theirs, both, weight, frames)
    return np.divide(mine, other, out=np.full_like(mine, np.nan), where=other > 0)


def _sums(
    values: Floats, there: NDArray[np.bool_], weight: Floats, frames: int | None
) -> tuple[Floats, Floats]:
    """Weighted sum and count (W, ...) of what is ``there``."""
    total = np.where(there, values, 0.0)
    count = there.astype(np.float64)
    if frames is not None:
        total, count = total.sum(axis=frames), count.sum(axis=frames)
    return np.tensordot(weight, total, axes=1), np.tensordot(weight, count, axes=1)


def _persistence(rows: Sequence[Judged]) -> int:
    return [row.name for row in rows].index(PERSISTENCE)


def _best_baseline(rows: Sequence[Judged], distance: Floats) -> int:
    """The baseline with the least mean distance (N, R, H) over the far frames."""
    far = distance[..., GROUPS[1][0] - 1 : GROUPS[1][1]].mean(axis=(0, 2))
    return min((i for i, row in enumerate(rows) if row.role == "baseline"), key=lambda i: far[i])
