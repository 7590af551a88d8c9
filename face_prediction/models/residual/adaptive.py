"""State of residual prediction: experts that learn from faces for as long as they are watched.

Every expert starts from the coefficients of the training people. What it adds for the watched face
is the posterior mean of a linear regression of its errors: the prior is the covariance of the
coefficients between people, and rows count by their age and, so that a blink or a detector's slip
teaches little, by their own error. Experts are mixed by their errors so far.

Several faces are followed at once, each by itself; they are seen for the first time together.

Shapes: N faces, D series, H horizons (knots, not every frame), K of them known, E experts, F
features of one, M slow means, S signs; a last axis of 2 holds U and V. An age is a number of frames
before the newest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from face_prediction.models.residual.experts import (
    SLOW,
    Floats,
    LinearExpert,
    frames_needed,
    linear_features,
    slow_rates,
)

ROBUST = 0.5
"""Share of the expected error below which the errors of rows count alike."""
OVERLAP = 0.5
"""Errors h frames ahead overlap with their neighbours': each counts 1 / (1 + OVERLAP (h - 1))."""
HORIZONS = (1, 2, 3, 4, 5, 8, 12, 18, 24)
"""Knots in frames ahead; between them the displacement is interpolated."""


@dataclass(frozen=True)
class Band:
    """Horizons that share the weights of rows, and so one matrix to be inverted.

    Attributes:
        knots: of `HORIZONS`.
        usual: place among these of the horizon whose errors the prior is measured by.
    """

    knots: slice
    usual: int


BANDS = (Band(slice(0, 5), 2), Band(slice(5, 9), 6))
"""Up to 5 frames ahead as at 3, beyond as at 12."""
SHARPNESS = 16.0
"""An expert whose error one frame ahead is 1 + d times the best one's has exp(-SHARPNESS d) times
its weight; further ahead as much less as a mean of overlapping errors is less certain."""
LEARNT_MEMORY = 200.0
"""Frames after which a row counts 1 / e in what an expert has learnt from a face."""
ERROR_MEMORY = 40.0
"""Frames after which an error counts 1 / e in what is expected of an expert, or of the mixture."""
CALM = 2e-3
"""Face sides a frame: the motion of a mouth that is slower is mostly the detector's jitter."""
MOST_CALM = 2.5
"""Logarithm of the speed below `CALM`, at most, that caution grows with."""
CAUTION = 0.8
"""Logarithm by which the error of an expert that adapts is assumed larger for each e-fold that the
mouth is slower than `CALM`: coefficients learnt from a moving face are worth little once it comes
to rest, and the iterated one, which is the best baseline, is what the mixture falls back to."""
PROVEN = 70.0
"""Frames after which caution falls as 1 / frames."""
PRIOR_ROWS = 20.0
"""Frames that the training people's errors count as, beside those of the watched face."""
PACE_MEMORY = 60.0
"""Frames after which a step counts 1 / e in the pace."""
MOST_PACE = 6.0
"""Times that a pace is beyond the median one, or below it, at most, where it predicts errors."""
LEAST_PACE = 1e-4
"""Face sides a frame: below the detector's jitter."""


@dataclass(frozen=True)
class LinearFit:
    """Training people's part of a linear expert.

    Attributes:
        expert: whose part it is.
        scale: (F,) standard deviation of the features.
        people: (H, F, D) coefficients of scaled features.
        precision: (2, F, F) inverse covariance of a person's coefficients about these, for each of
            `BANDS`; None for the iterated expert, which does not adapt.
    """

    expert: LinearExpert
    scale: Floats
    people: Floats
    precision: Floats | None


@dataclass(frozen=True)
class PeopleFit:
    """All that is fitted to the training people, but the principal shapes and the intervals.

    Attributes:
        horizons: (H,) frames ahead.
        linear: fits of all experts.
        usual: (E + 1, H, 2) constant and slope of the logarithm of an expert's mean error over the
            pace of a face, by the logarithm of that pace over ``pace``; the last is the mixture.
        pace: median mean step of the mouth, in face sides.
        unlearnt: frames at the beginning of a track from whose forecasts nothing is learnt, as
            they were made as if the face had been at rest before.
    """

    horizons: NDArray[np.int64]
    linear: tuple[LinearFit, ...]
    usual: Floats
    pace: float
    unlearnt: int = 0

    @property
    def recent(self) -> int:
        """W, recent frames that a forecast is made from."""
        return frames_needed(fit.expert for fit in self.linear)

    def until(self, horizon: int) -> PeopleFit:
        """Return the part that forecasts ``horizon`` frames ahead: the first band, or both."""
        count = BANDS[0].knots.stop if horizon <= self.horizons[BANDS[0].knots.stop - 1] else None
        if count is None:
            return self
        linear = tuple(replace(fit, people=fit.people[:count]) for fit in self.linear)
        return replace(
            self, horizons=self.horizons[:count], linear=linear, usual=self.usual[:, :count]
        )

    def usual_errors(self, pace: Floats) -> Floats:
        """Errors (N, E + 1, H) that faces with a pace (N,) make usual, in face sides."""
        relative = np.log(np.clip(pace / self.pace, 1 / MOST_PACE, MOST_PACE))[:, None, None]
        return np.exp(self.usual[..., 0] + self.usual[..., 1] * relative) * pace[:, None, None]


@dataclass(frozen=True)
class StateForecast:
    """Forecast of N faces, as displacements from the newest frame.

    Attributes:
        moved: (N, H, D).
        signs: (N, H, S) logarithms from which the size of the mouth's error is estimated, see
            `intervals`.
        experts: (N, E, H, D) forecasts of every expert.
        features: (N, F) scaled, of every expert.
    """

    moved: Floats
    signs: Floats
    experts: Floats
    features: tuple[Floats, ...]


class Mixture:
    """Weights of the experts on N faces, by their errors so far.

    Args:
        fit: of the training people.
        faces: N.
    """

    def __init__(self, fit: PeopleFit, faces: int) -> None:
        self.fit, self.frames = fit, 0
        knots, top = len(fit.horizons), int(fit.horizons[-1])
        self._steps = np.zeros(faces)
        self._errors = np.zeros((faces, len(fit.linear), knots))
        self._mixed_errors = np.zeros((faces, knots))
        self._late_errors = np.zeros((faces, knots))
        self._count, self._late_count = np.zeros(knots), np.zeros(knots)
        self._moved = Ring(top, (faces, knots, 2))
        self._experts = Ring(top, (faces, len(fit.linear), knots, 2))

    def keep(self, faces: int) -> None:
        """Go on with the first so many faces."""
        for name in ("_steps", "_errors", "_mixed_errors", "_late_errors"):
            setattr(self, name, getattr(self, name)[:faces])
        self._moved.keep(faces)
        self._experts.keep(faces)

    @property
    def pace(self) -> Floats:
        """Mean step (N,) of the mouth so far, in face sides a frame."""
        memory = np.exp(-1 / PACE_MEMORY)
        seen = (1 - memory**self.frames) / (1 - memory)
        mean = (self._steps + PRIOR_ROWS * self.fit.pace) / (seen + PRIOR_ROWS)
        return np.maximum(mean, LEAST_PACE)

    def known(self) -> NDArray[np.int64]:
        """Horizons (K,) whose forecast was made from a frame that was seen and is learnt from."""
        horizons, oldest = self.fit.horizons, self.frames - 1 - self.fit.unlearnt
        return horizons[: int(np.searchsorted(horizons, oldest, side="right"))]

    def expected_errors(self) -> tuple[Floats, Floats]:
        """Mean errors so far of the experts (N, E, H) and of the mixture (N, H)."""
        usual = PRIOR_ROWS * self.fit.usual_errors(self.pace)
        rows = self._count + PRIOR_ROWS
        return (self._errors + usual[:, :-1]) / rows, (self._mixed_errors + usual[:, -1]) / rows

    def take(self, step: Floats) -> None:
        """Take in the next frame, in which the mouth moved by ``step`` (N,) on average."""
        self._steps = self._steps * np.exp(-1 / PACE_MEMORY) + step
        self.frames += 1

    def outcomes(self) -> Floats:
        """Forecasts (N, K, 2) of the mouth that the newest frame decides."""
        return self._moved.of_horizons(self.known())

    def learn(self, truth: Floats) -> Floats:
        """Learn from the mouth's displacements (N, K, 2) up to the newest frame.

        Returns:
            Errors (N, K, E) of the experts.
        """
        ages = self.known()
        known = slice(len(ages))
        made = self._experts.of_horizons(ages, axis=1).swapaxes(1, 2)  # (N, K, E, 2)
        errors = np.abs(made - truth[:, :, None]).mean(axis=-1)
        mixed = np.abs(self.outcomes() - truth).mean(axis=-1)
        for sums, memory, more in (
            (self._errors, ERROR_MEMORY, errors.swapaxes(1, 2)),
            (self._mixed_errors, ERROR_MEMORY, mixed),
            (self._count, ERROR_MEMORY, 1),
            (self._late_errors, LATE_MEMORY, mixed),
            (self._late_count, LATE_MEMORY, 1),
        ):
            sums[..., known] = np.exp(-1 / memory) * sums[..., known] + more
        return errors

    def mix(self, experts: Floats, recent: Floats) -> tuple[Floats, Floats]:
        """Mix the experts' forecasts.

        Args:
            experts: (N, E, H, D) displacements.
            recent: (N, W, D) frames that they were made from.

        Returns:
            Displacements (N, H, D), and signs (N, H, S) of the size of their error.
        """
        errors, expected = self.expected_errors()
        speed = np.abs(np.diff(recent[:, -4:, :2], axis=1)).mean(axis=(1, 2)) + LEAST_PACE / 4
        cautious = errors * self._caution(speed)
        sharpness = SHARPNESS / np.sqrt(overlap(self.fit.horizons))
        share = np.exp(-sharpness * (cautious / cautious.min(axis=1, keepdims=True) - 1))
        share /= share.sum(axis=1, keepdims=True)  # (N, E, H)
        moved = np.einsum("neh,nehd->nhd", share, experts)
        apart = np.abs(experts[..., :2] - moved[:, None, :, :2]).mean(axis=-1)
        late = (self._late_errors + 3 * expected) / (self._late_count + 3)
        signs = [
            expected,
            late + LEAST_PACE / 4,
            np.broadcast_to(speed[:, None], expected.shape),
            (share * apart).sum(axis=1) + LEAST_PACE / 4,
        ]
        return moved, np.log(np.stack(signs, axis=-1))

    def remember(self, moved: Floats, experts: Floats) -> None:
        """Keep forecasts (N, H, D) and (N, E, H, D), to learn from their outcome."""
        self._moved.push(moved[..., :2])
        self._experts.push(experts[..., :2])

    def _caution(self, speed: Floats) -> Floats:
        """Factors (N, E, 1) on the errors of the experts at a speed (N,) of the mouth."""
        calm = np.clip(np.log(CALM / speed), 0, MOST_CALM) * min(1.0, PROVEN / self.frames)
        caution = np.where([part.expert.iterated for part in self.fit.linear], 0.0, CAUTION)
        return np.exp(calm[:, None] * caution)[..., None]


class FaceState:
    """State of N faces that are followed from frame to frame.

    Args:
        fit: of the training people.
        faces: N.
    """

    def __init__(self, fit: PeopleFit, faces: int) -> None:
        self.fit, self.mixture = fit, Mixture(fit, faces)
        top = int(fit.horizons[-1])
        series = fit.linear[0].people.shape[-1]
        self._recent = np.zeros((faces, max(fit.recent, top + 1), series))
        self._slow = np.zeros((faces, len(SLOW), series))
        bands = [band for band in BANDS if band.knots.start < len(fit.horizons)]
        self._learners = [_Learner(part, faces, bands, fit.horizons) for part in fit.linear]

    def keep(self, faces: int) -> None:
        """Go on with the first so many faces."""
        self._recent, self._slow = self._recent[:faces], self._slow[:faces]
        for part in (self.mixture, *self._learners):
            part.keep(faces)

    def recent(self, count: int) -> Floats:
        """The last frames (N, count, D) taken in; before the first one the face was at rest."""
        return self._recent[:, -count:]

    def take(self, series: Floats) -> None:
        """Take in the next frame (N, D), and learn from the forecasts that it decides."""
        frames = self.mixture.frames
        if frames:
            self._recent = _pushed(self._recent, series)
            self._slow += slow_rates(frames)[:, None] * (series[:, None] - self._slow)
        else:
            self._recent[:], self._slow[:] = series[:, None], series[:, None]
        self.mixture.take(np.abs(np.diff(self._recent[:, -2:, :2], axis=1)).mean(axis=(1, 2)))
        ages = self.mixture.known()
        if not len(ages):
            return
        truth = self._recent[:, -1:] - self._recent[:, -1 - ages]
        errors = self.mixture.learn(truth[..., :2])
        expected = self.mixture.expected_errors()[1]
        for number, learner in enumerate(self._learners):
            learner.learn(errors[..., number], expected, truth, ages)

    def forecast(self, recent: Floats | None = None) -> StateForecast:
        """Forecast from the newest frame, or from other ``recent`` frames (N, W, D)."""
        recent = self.recent(self.fit.recent) if recent is None else recent
        features = tuple(learner.features(recent, self._slow) for learner in self._learners)
        experts = np.stack(
            [learner.forecast(own) for learner, own in zip(self._learners, features, strict=True)],
            axis=1,
        )
        moved, signs = self.mixture.mix(experts, recent)
        return StateForecast(moved, signs, experts, features)

    def remember(self, made: StateForecast) -> None:
        """Keep the forecast from the frame taken in last, to learn from its outcome."""
        self.mixture.remember(made.moved, made.experts)
        for learner, features in zip(self._learners, made.features, strict=True):
            learner.remember(features)

    def outcomes(self) -> tuple[Floats, Floats]:
        """Forecasts of the mouth and truth (N, K, 2) that the newest frame decided."""
        ages = self.mixture.known()
        truth = self._recent[:, -1:, :2] - self._recent[:, -1 - ages, :2]
        return self.mixture.outcomes(), truth


class Ring:
    """The last rows of a series of arrays, without copying the others when one is added.

    Args:
        length: rows kept.
        shape: of one, (N, ...).
    """

    def __init__(self, length: int, shape: tuple[int, ...]) -> None:
        self._rows, self._count = np.zeros((length, *shape)), 0

    def keep(self, faces: int) -> None:
        """Go on with the first so many faces."""
        self._rows = self._rows[:, :faces]

    def push(self, row: Floats) -> None:
        """Add a row (N, ...), in place of the oldest."""
        self._rows[self._count % len(self._rows)] = row
        self._count += 1

    def row(self, age: int) -> Floats:
        """The row (N, ...) of an age, 1 being the newest."""
        return self._rows[(self._count - age) % len(self._rows)]

    def rows(self, ages: NDArray[np.int64]) -> Floats:
        """The rows (K, N, ...) of ages (K,)."""
        return self._rows[(self._count - ages) % len(self._rows)]

    def of_horizons(self, ages: NDArray[np.int64], axis: int = 0) -> Floats:
        """Of each row of ``ages`` (K,) its own horizon: the k-th along ``axis`` after the faces."""
        rows, own = self.rows(ages), np.arange(len(ages))
        chosen = np.moveaxis(rows, axis + 2, 1)[own, own]  # (K, N, ...)
        return np.moveaxis(chosen, 0, axis + 1)


class _Learner:
    """State that a linear expert has learnt from N faces.

    A row is learnt from when its outcome is known, h frames later. All horizons of a band weight it
    alike, so that their matrices are one that grows from frame to frame, seen h frames ago.
    """

    def __init__(
        self,
        fit: LinearFit,
        faces: int,
        bands: Sequence[Band],
        horizons: NDArray[np.int64],
    ) -> None:
        self.fit, self._bands, self._horizons = fit, bands, horizons
        size, top = fit.expert.size, int(horizons[-1])
        self._series = fit.people.shape[-1]
        self._people = fit.people.swapaxes(0, 1).reshape(size, -1)
        self._past, self._made = (
            Ring(top, (faces, size)),
            Ring(top, (faces, len(horizons), self._series)),
        )
        self._weights = [Ring(top, (faces,)) for _ in bands]
        if fit.precision is None:
            return
        self._gram = np.zeros((len(bands), faces, size, size))
        self._cross = np.zeros((len(horizons), faces, size, self._series))
        self._inverse: list[Ring] = []
        for band, precision in zip(bands, fit.precision, strict=False):
            # as they were when the first horizon of the band knew no more
            own = horizons[band.knots]
            inverse = Ring(int(own[-1] - own[0]) + 1, (faces, size, size))
            for _ in range(int(own[-1] - own[0]) + 1):
                inverse.push(np.linalg.inv(precision)[None])
            self._inverse.append(inverse)

    def keep(self, faces: int) -> None:
        """Go on with the first so many faces."""
        for ring in (self._past, self._made, *self._weights):
            ring.keep(faces)
        if self.fit.precision is not None:
            self._gram, self._cross = self._gram[:, :faces], self._cross[:, :faces]
            for ring in self._inverse:
                ring.keep(faces)

    def features(self, recent: Floats, slow: Floats) -> Floats:
        """Scaled features (N, F) of recent frames (N, W, D)."""
        return linear_features(self.fit.expert, recent, slow) / self.fit.scale

    def remember(self, features: Floats) -> None:
        """Keep the features (N, F) of a forecast, to learn from its outcome."""
        self._past.push(features)
        self._made.push(self._of_people(features))

    def forecast(self, features: Floats) -> Floats:
        """Displacements (N, H, D) from scaled features (N, F)."""
        result = self._of_people(features)
        if self.fit.precision is None:
            return result
        for band, inverse in zip(self._bands, self._inverse, strict=True):
            own = self._horizons[band.knots]
            gain = (features[:, None] @ inverse.rows(own - own[0] + 1)) @ self._cross[band.knots]
            result[:, band.knots] += gain[:, :, 0].swapaxes(0, 1)
        return result

    def _of_people(self, features: Floats) -> Floats:
        """Displacements (N, H, D) by the training people's coefficients."""
        size = len(features), len(self._horizons), self._series
        # Face by face, as BLAS rounds otherwise for another number of them.
        return (features[:, None] @ self._people).reshape(size)

    def learn(
        self, errors: Floats, expected: Floats, truth: Floats, ages: NDArray[np.int64]
    ) -> None:
        """Learn from the outcomes of K horizons.

        Args:
            errors: (N, K) of this expert.
            expected: (N, H) errors of the mixture.
            truth: (N, K, D) displacements.
            ages: (K,) of the forecasts, the first K horizons.
        """
        if self.fit.precision is None:
            return
        memory, people = np.exp(-1 / LEARNT_MEMORY), self._made.of_horizons(ages)
        for number, band in enumerate(self._bands):
            first, stop = band.knots.start, min(band.knots.stop, len(ages))
            if first >= stop:
                break
            horizon = int(self._horizons[band.usual])
            row = self._past.row(int(ages[first]))
            ratio = errors[:, first] / expected[:, first]
            self._weights[number].push(row_weights(ratio, expected[:, band.usual], horizon))
            weighted = self._weights[number].row(1)[:, None] * row
            gram = self._gram[number]
            gram *= memory
            gram += weighted[..., None] * row[:, None]
            self._inverse[number].push(np.linalg.inv(gram + self.fit.precision[number]))
            decided = ages[first:stop]
            missed = (truth - people)[:, first:stop].swapaxes(0, 1)
            weights = self._weights[number].rows(decided - decided[0] + 1)
            cross = self._cross[first:stop]
            cross *= memory
            cross += (weights[..., None] * self._past.rows(decided))[..., None] * missed[:, :, None]


LATE_MEMORY = 8.0
"""Frames after which an error counts 1 / e among the late ones, which intervals follow."""


def overlap(horizon: ArrayLike) -> Floats:
    """Errors that count together as one, (...) for ``horizon`` (...) frames ahead."""
    return 1 + OVERLAP * (np.asarray(horizon, dtype=np.float64) - 1)


def row_weights(ratio: Floats, usual: Floats, horizon: int) -> Floats:
    """Weights (...) of rows whose error is ``ratio`` (...) times what was expected.

    Those of a Laplace density whose mean is ``usual`` (...) at ``horizon``, in the least-squares
    form of iterative reweighting; less for errors that overlap with their neighbours'.
    """
    return 1 / (overlap(horizon) * usual**2 * np.sqrt(ratio**2 + ROBUST**2))


def _pushed(past: Floats, newest: Floats) -> Floats:
    """The rows (N, T, ...) without the oldest, and with the newest (N, ...)."""
    return np.concatenate([past[:, 1:], newest[:, None]], axis=1)
