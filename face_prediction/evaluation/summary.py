"""From residuals to the numbers of the tables, each with its interval.

One bootstrap over people serves all numbers of a kind of footage, so that every resample holds the
same sequences of every row.

Legend: N sequences, W resamples of them, R rows (contestants), H horizon, G groups of horizons, K
levels; an axis of 2 holds U and V.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.evaluation.bootstrap import percentile_bounds, resample_counts
from face_prediction.evaluation.calibration import covered
from face_prediction.evaluation.contestants import PERSISTENCE, Role
from face_prediction.evaluation.judge import Judged, Verdict
from face_prediction.evaluation.mouth_errors import mouth_distances

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
        mean = _mean(absolute, weight, frames)
        square = _mean(absolute**2, weight, frames)
        result[f"{prefix}mean"] = mean
        result[f"{prefix}variance"] = np.maximum(square - mean**2, 0.0)
        for name in AVERAGED:
            result[f"{prefix}{name}"] = _mean(data[name], weight, frames)
        result[f"{prefix}coverage"] = _mean(data["covered"], weight, frames)
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


def _mean(values: Floats, weight: Floats, frames: int | None) -> Floats:
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
