"""Fit of residual prediction to the tracks of training people.

Coefficients are those of the least absolute error, whose sum over all frames is what predictors are
compared by. The spread of a person's own coefficients about them, by expectation maximisation, is
the prior that a face's own frames have to overcome.

Shapes: N rows (frames of all tracks), P people, D series, H horizons, F features of an expert.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.autoregression import principal_shapes
from face_prediction.forecast.interface import subject_folds
from face_prediction.models.residual.adaptive import (
    BANDS,
    HORIZONS,
    LEARNT_MEMORY,
    LEAST_PACE,
    MOST_PACE,
    LinearFit,
    Mixture,
    PeopleFit,
    row_weights,
)
from face_prediction.models.residual.experts import (
    EXPERTS,
    SHAPES,
    Floats,
    LinearExpert,
    frames_needed,
    linear_features,
    recent_frames,
    slow_means,
)
from face_prediction.models.residual.intervals import (
    SIGNS,
    IntervalFit,
    measure_intervals,
)
from face_prediction.models.residual.predictor import (
    ResidualFit,
    face_series,
    face_side,
    follow_tracks,
)
from robo_manip_baselines.runs.errors import RequestError

RIDGE = 3e-3
"""Share of the features' mean square that is added to the diagonal."""
_ROUNDS = 4  # of reweighting from least squares to least absolute error
_SMALL_ERROR = 1e-3  # face sides: errors below it count alike
_STILL = 1e-3  # face sides: a track with this mean step of the mouth counts half
_STRIDE = 2  # frames between rows that are fitted to: neighbours are alike
_WARM_UP = 10  # frames at the beginning of a track that are left out: they have no past
_EM_ROUNDS = 10
_MOST_ROOT = 0.99  # modulus of an iterated expert's eigenvalues, as of the baseline's
_FIRST_SPREAD = 0.05  # of coefficients of scaled features, where the maximisation begins
_LEAST_SPREAD = 1e-3  # share of the mean variance added to every one
_MEASURED = 500  # frames at the beginning of a track that errors are measured on
_LEAST_ROWS = 30  # of a person, for a part in the spread


@dataclass(frozen=True)
class Rows:
    """All frames of the training tracks, one after another.

    Attributes:
        series: (N, D).
        recent: (N, W, D).
        slow: (N, M, D).
        person: (N,) number of the person.
        seen: (N,) frames before this one in its track.
        left: (N,) frames after it.
        pace: (N,) mean step of the mouth in its track.
    """

    series: Floats
    recent: Floats
    slow: Floats
    person: NDArray[np.int64]
    seen: NDArray[np.int64]
    left: NDArray[np.int64]
    pace: Floats

    @classmethod
    def of(cls, tracks: Sequence[Floats], subjects: Sequence[str], recent: int) -> Rows:
        """Put tracks (T, D) one after another, with W = ``recent``."""
        lengths = [len(track) for track in tracks]
        people = np.unique(np.asarray(subjects), return_inverse=True)[1]
        paces = [np.abs(np.diff(track[:, :2], axis=0)).mean() for track in tracks]
        numbers = np.repeat(np.arange(len(tracks)), lengths)
        return cls(
            series=np.concatenate(tracks),
            recent=np.concatenate([recent_frames(track, recent) for track in tracks]),
            slow=np.concatenate([slow_means(track) for track in tracks]),
            person=people[numbers],
            seen=np.concatenate([np.arange(n) for n in lengths]),
            left=np.concatenate([np.arange(n)[::-1] for n in lengths]),
            pace=np.maximum(np.array(paces), LEAST_PACE)[numbers],
        )

    def origins(self, horizon: int) -> NDArray[np.int64]:
        """Rows with a past, and ``horizon`` frames after them."""
        is_fitted = (self.seen >= _WARM_UP) & (self.seen % _STRIDE == 0)
        return np.flatnonzero(is_fitted & (self.left >= horizon))


def fit_people(
    tracks: Sequence[Floats],
    subjects: Sequence[str],
    experts: Sequence[LinearExpert] = EXPERTS,
    ridge: float = RIDGE,
) -> PeopleFit:
    """Fit experts to tracks (T, D) of people.

    All errors count as alike: `fit_residual` measures them.
    """
    rows, knots = Rows.of(tracks, subjects, frames_needed(experts)), np.array(HORIZONS)
    linear = tuple(fit_linear(expert, rows, knots, ridge) for expert in experts)
    growth = np.log(np.tile(knots.astype(np.float64), (len(experts) + 1, 1)))
    usual = np.stack([growth, np.zeros_like(growth)], axis=-1)
    return PeopleFit(knots, linear, usual, float(np.median(rows.pace[rows.seen == 0])))


def fit_linear(
    expert: LinearExpert, rows: Rows, horizons: NDArray[np.int64], ridge: float
) -> LinearFit:
    """Fit one expert: scale, people's coefficients, and spread between people."""
    features = linear_features(expert, rows.recent, rows.slow)
    scale = features.std(axis=0) + 1e-9
    features = features / scale
    size, count = expert.size, len(horizons)
    people = np.empty((count, size, rows.series.shape[1]))
    usual = [band.usual for band in BANDS]
    precision = np.empty((len(BANDS), size, size))
    if expert.iterated:
        moved = iterated(expert, features, scale, rows, horizons, ridge)
        return LinearFit(expert, scale, moved, None)
    for place, horizon in enumerate(horizons.tolist()):
        origins = rows.origins(horizon)
        x = features[origins]
        y = rows.series[origins + horizon] - rows.series[origins]
        people[place] = least_absolute(x, y, rows.pace[origins], ridge)
        if place in usual:
            rest = (y - x @ people[place])[:, :2]
            precision[usual.index(place)] = spread(x, rest, rows.person[origins], horizon)
    return LinearFit(expert, scale, people, precision)


def iterated(
    expert: LinearExpert,
    features: Floats,
    scale: Floats,
    rows: Rows,
    horizons: NDArray[np.int64],
    ridge: float,
) -> Floats:
    """Coefficients (H, F, D) of an autoregression that is iterated.

    Args:
        expert: whose features they are.
        features: (N, F) divided by their scale.
        scale: (F,).
        rows: of all tracks.
        horizons: (H,).
        ridge: see `RIDGE`.
    """
    origins = rows.origins(1)
    x = features[origins]
    y = rows.series[origins + 1] - rows.series[origins]
    step = least_absolute(x, y, rows.pace[origins], ridge)  # (F, D)
    kept = len(expert.columns)
    onward = np.zeros((expert.size, expert.size))  # features of the next frame from these
    onward[kept:, :-kept] = np.diag(scale[kept:] / scale[:-kept])
    onward[:, -kept:] = step[:, expert.columns] / scale[-kept:]
    largest = np.abs(np.linalg.eigvals(onward)).max()
    if largest > _MOST_ROOT:  # its expectation would not converge
        onward *= _MOST_ROOT / largest
    moved, power = np.zeros((len(horizons), *step.shape)), np.eye(expert.size)
    for horizon in range(1, int(horizons[-1]) + 1):
        moved[horizons >= horizon] += power @ step
        power = power @ onward
    return moved


def least_absolute(x: Floats, y: Floats, pace: Floats, ridge: float) -> Floats:
    """Coefficients (F, D) of the least absolute error of y's first two columns, the mouth.

    Errors below `_SMALL_ERROR` count alike, and rows of tracks whose ``pace`` (N,) is far below
    `_STILL` little. ``ridge``: see `RIDGE`.
    """
    weight = used = pace / (pace + _STILL)
    solution = np.zeros((x.shape[1], y.shape[1]))
    for iteration in range(_ROUNDS):
        if iteration:
            error = np.abs(y[:, :2] - x @ solution[:, :2]).mean(axis=1)
            used = weight / np.sqrt(error**2 + _SMALL_ERROR**2)
            used = used / used.mean()
        weighted = x * used[:, None]
        gram = weighted.T @ x + ridge * len(x) * np.eye(x.shape[1])
        solution = np.linalg.solve(gram, weighted.T @ y)
    return solution


def spread(x: Floats, missed: Floats, person: NDArray[np.int64], horizon: int) -> Floats:
    """Inverse covariance (F, F) between people of what corrects errors (N, 2) on features (N, F).

    Expectation maximisation of a hierarchical linear model. A person's rows count together as many
    as a face's that has been watched for `LEARNT_MEMORY` frames, weighted as `row_weights` does.
    """
    grams: list[Floats] = []
    crosses: list[Floats] = []
    for number in np.unique(person):
        own = np.flatnonzero(person == number)
        if len(own) < _LEAST_ROWS:
            continue
        error = np.abs(missed[own]).mean(axis=1)
        expected = max(float(error.mean()), LEAST_PACE)
        weight = row_weights(error / expected, np.full(len(own), expected), horizon)
        weighted = x[own] * weight[:, None] * min(_STRIDE, LEARNT_MEMORY / len(own))
        grams.append(weighted.T @ x[own])
        crosses.append(weighted.T @ missed[own])
    size = x.shape[1]
    covariance = _FIRST_SPREAD * np.eye(size)
    gram, cross = np.array(grams), np.array(crosses)
    for _ in range(_EM_ROUNDS if grams else 0):
        posterior = np.linalg.inv(gram + np.linalg.inv(covariance))
        mean = posterior @ cross
        covariance = (np.einsum("pfa,pga->fg", mean, mean) / 2 + posterior.sum(axis=0)) / len(gram)
        covariance += _LEAST_SPREAD * np.trace(covariance) / size * np.eye(size)
    return np.linalg.inv(covariance)


def fit_residual(tracks: Sequence[NDArray[np.floating]], subjects: Sequence[str]) -> ResidualFit:
    """Fit everything to tracks (T, L, 2) of people, in any units of their own.

    Intervals are measured on people that the coefficients were not fitted to: each half of the
    people by a fit to the other half.

    Raises:
        RequestError: there are fewer than two people, or the tracks of either half are too short.
    """
    names, half = sorted(set(subjects)), subject_folds(subjects, 2)
    if len(names) < 2 or max(map(len, tracks), default=0) <= _WARM_UP + 2 * HORIZONS[-1]:
        needed = f"2 or more with tracks of more than {_WARM_UP + 2 * HORIZONS[-1]} frames"
        raise RequestError(f"tracks of {len(names)} people; residual needs {needed}")
    for part in range(2):
        own = {name for name, place in zip(subjects, half, strict=True) if place == part}
        longest = max(len(t) for t, name in zip(tracks, subjects, strict=True) if name in own)
        if longest <= _WARM_UP + HORIZONS[-1]:
            raise RequestError(
                f"tracks of {', '.join(sorted(own)[:3])}: {longest} frames at most; residual is "
                f"fitted to each half of the people and needs one of more than "
                f"{_WARM_UP + HORIZONS[-1]} in either; add footage of other people"
            )
    shown = [track / face_side(track[0]) for track in tracks]
    basis = shapes_of(shown)
    series = [face_series(track, basis) for track in shown]
    people = fit_people(series, subjects)
    made: list[Floats] = [np.empty(0)] * len(series)
    mixed: list[Floats] = [np.empty(0)] * len(series)
    for part in range(2):
        own, others = (np.flatnonzero((half == part) == same).tolist() for same in (True, False))
        fit = fit_people([series[i] for i in others], [subjects[i] for i in others])
        fit = replace(fit, usual=people.usual, pace=people.pace)
        tried = trial(
            ResidualFit(basis, fit, IntervalFit.unknown()), [series[i][:_MEASURED] for i in own]
        )
        for number, (experts, mixture) in zip(own, tried, strict=True):
            made[number], mixed[number] = experts, mixture
    measured = [track[:_MEASURED] for track in series]
    usual = usual_errors(made, mixed, measured, people.pace)
    people = replace(people, usual=usual)
    signs, errors = mix_again(people, made, measured)
    return ResidualFit(basis, people, measure_intervals(signs, errors))


def trial(fit: ResidualFit, tracks: Sequence[Floats]) -> list[tuple[Floats, Floats]]:
    """Forecast tracks (T, D) from every frame.

    Returns:
        Forecasts of the mouth of each track by the experts (T, E, H, 2) and the mixture (T, H, 2).
    """
    shape = (len(fit.people.linear), len(fit.people.horizons), 2)
    made: list[tuple[Floats, Floats]] = [
        (np.empty((len(t), *shape)), np.empty((len(t), *shape[1:]))) for t in tracks
    ]
    for frame, numbers, _, forecast in follow_tracks(fit, tracks, HORIZONS[-1]):
        for place, number in enumerate(numbers):
            made[number][0][frame] = forecast.experts[place, ..., :2]
            made[number][1][frame] = forecast.moved[place, :, :2]
    return made


def missed(made: Floats, track: Floats) -> Floats:
    """Errors (T, ..., H, 2) of forecasts of the mouth; NaN where the track (T, D) had ended.

    NaN too while it had no past.
    """
    errors = np.full(made.shape, np.nan)
    for place, horizon in enumerate(HORIZONS):
        last = len(track) - horizon
        if last > _WARM_UP:
            own = slice(_WARM_UP, last)
            truth = track[_WARM_UP + horizon :, :2] - track[own, :2]
            truth = truth.reshape(len(truth), *[1] * (made.ndim - 3), 2)
            errors[own, ..., place, :] = made[own, ..., place, :] - truth
    return errors


def usual_errors(
    made: Sequence[Floats], mixed: Sequence[Floats], tracks: Sequence[Floats], pace: float
) -> Floats:
    """`PeopleFit.usual`: the line through the mean errors of tracks (T, D), by their pace.

    Args:
        made: forecasts (T, E, H, 2) by the experts.
        mixed: by the mixture (T, H, 2).
        tracks: (T, D).
        pace: the median one.
    """
    relative: list[Floats] = []
    paces: list[float] = []
    for experts, mixture, track in zip(made, mixed, tracks, strict=True):
        errors = missed(np.concatenate([experts, mixture[:, None]], axis=1), track)
        sizes = np.abs(errors).mean(axis=-1)  # (T, E + 1, H)
        if np.isfinite(sizes).any(axis=0).all():
            paces.append(max(float(np.abs(np.diff(track[:, :2], axis=0)).mean()), LEAST_PACE))
            relative.append(np.log(np.nanmean(sizes, axis=0) / paces[-1] + 1e-9))
    ratio = np.log(np.clip(np.array(paces) / pace, 1 / MOST_PACE, MOST_PACE))
    rows = np.stack([np.ones_like(ratio), ratio], axis=1)
    solution = np.linalg.lstsq(rows, np.array(relative).reshape(len(ratio), -1), rcond=None)[0]
    return solution.T.reshape(-1, len(HORIZONS), 2)


def mix_again(
    people: PeopleFit, made: Sequence[Floats], tracks: Sequence[Floats]
) -> tuple[Floats, Floats]:
    """Mix the experts' forecasts (T, E, H, 2) of tracks (T, D) with other usual errors.

    Returns:
        Signs (N, H, S), see `intervals`, and errors (N, H, 2) of the mixture in all frames, NaN
        where there is none.
    """
    order = sorted(range(len(tracks)), key=lambda number: -len(tracks[number]))
    recent = [recent_frames(track[:, :2], people.recent) for track in tracks]
    signs = [np.empty((len(track), len(HORIZONS), SIGNS)) for track in tracks]
    moved = [np.empty((len(track), len(HORIZONS), 2)) for track in tracks]
    mixture = Mixture(people, len(order))
    for frame in range(len(tracks[order[0]])):
        alive = [number for number in order if len(tracks[number]) > frame]
        mixture.keep(len(alive))
        seen = np.stack([recent[number][frame] for number in alive])
        mixture.take(np.abs(seen[:, -1] - seen[:, -2]).mean(axis=1))
        ages = mixture.known()
        if len(ages):
            mouth = [tracks[number][:, :2] for number in alive]
            mixture.learn(np.stack([track[frame] - track[frame - ages] for track in mouth]))
        experts = np.stack([made[number][frame] for number in alive])
        forecast, of_frame = mixture.mix(experts, seen)
        mixture.remember(forecast, experts)
        for place, number in enumerate(alive):
            moved[number][frame], signs[number][frame] = forecast[place], of_frame[place]
    errors = [missed(own, track) for own, track in zip(moved, tracks, strict=True)]
    return np.concatenate(signs), np.concatenate(errors)


def shapes_of(tracks: Sequence[NDArray[np.floating]]) -> Floats:
    """Principal shapes (K, 2 L) of tracks (T, L, 2), about the mean of every 75 frames or so."""
    length = min(75, *map(len, tracks))
    pieces = [
        track[first : first + length]
        for track in tracks
        for first in range(0, len(track) - length + 1, length)
    ]
    return principal_shapes(np.stack(pieces), SHAPES)
