"""Corruption of the observed target: ``truth -> predict -> error -> delay -> dropout``.

Legend: T control steps, K frames from now to the longest known horizon, H horizons of the error, F
video frames, J detections at the detector's own rate, ... any shape of times.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from annotated_types import Interval
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.observation.error_models import DRAWN_ERRORS, WORLD_FROM_IMAGE, Draw
from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.observation.state import (
    FRAME_PERIOD,
    FRAME_RATE,
    Floats,
    State,
    TargetObservation,
)
from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import (
    RequestError,
    require_choice,
    require_integer,
    require_printable,
)
from robo_manip_baselines.runs.ranges import MAX_SEED, Fraction, Seed, require_ranges

MEASURED_ERRORS = tuple(DRAWN_ERRORS)
"""Errors of the forecast that are drawn from the statistics of a file."""

ERRORS = ("none", *MEASURED_ERRORS, "model")
"""Errors of the forecast; ``model`` is the recorded output of a trained predictor."""

FORECASTERS = (
    *("persistence", "constant_velocity", "autoregression", "kalman", "residual"),
    "shuffled",
)
"""Forecasters that know the past of the target alone; ``shuffled`` is a control."""

PREDICTIONS = ("truth", *FORECASTERS)
"""Future of the target before errors: the true one, or that of a forecaster."""

MAX_DELAY = 900
"""Frames, half a minute: longer than any episode."""

DROPOUT_LENGTH = 15.0
"""Default mean length of a loss of the face, frames: half a second."""

_FIRST_FRAMES = 512
"""Frames drawn when an episode starts, 17 s; a longer episode draws more."""

_FIRST_STEPS = 1024
"""Steps allocated when an episode starts; a longer episode allocates more."""

_TIME_ROUNDING = 1e-7
"""s by which times that are meant to be the same may differ."""

_FRAME_ROUNDING = 1e-6
"""Frames by which a time may fall short of a frame and still belong to it."""


@dataclass(frozen=True)
class Corruption:
    """Errors of the forecast, delay, lost faces, and a detector slower than the robot.

    Everything is off by default, and a `Corruption` that is off is false.

    Attributes:
        error: Error of the forecast: none, uniform (the paper's), gaussian, empirical (measured
            errors replayed) or model (recorded output of a trained predictor).
        error_stats: File of error statistics; the shipped one if None.
        stats_sha256: SHA-256 of that file, where a policy was trained with it; any if None.
        delay: Frames of 1/30 s from the camera to the policy.
        face_dropout: Share of the frames, 0 up to 1, in which the face is lost.
        face_dropout_length: Mean length of a loss, frames.
        detector_rate: Detections per second, at most 30; one at every control step if None.
        seed: Seed of errors and losses, beside that of the episode.
        prediction: Forecast of the target: truth (its true future), or that of a forecaster, made
            at each control step of the target until then: persistence, constant_velocity,
            autoregression, kalman, residual (fitted to the motion) or shuffled (motion of another
            episode).

    Raises:
        RequestError: a value is not valid.
    """

    error: str = "none"
    error_stats: str | None = None
    stats_sha256: tyro.conf.Suppress[str | None] = None
    delay: Annotated[int, Interval(ge=0, le=MAX_DELAY)] = 0
    face_dropout: Fraction = 0.0
    face_dropout_length: Annotated[float, Interval(ge=1.0, le=1e6)] = DROPOUT_LENGTH
    detector_rate: Annotated[float, Interval(gt=0.0, le=FRAME_RATE)] | None = None
    seed: Annotated[Seed, tyro.conf.arg(name="corruption_seed")] = 0
    prediction: str = "truth"

    def __post_init__(self) -> None:
        require_choice("error model", self.error, ERRORS)
        require_choice("prediction", self.prediction, PREDICTIONS)
        if self.prediction != "truth" and self.error != "none":
            raise RequestError(
                f"prediction '{self.prediction}' goes without an error, not with '{self.error}'; "
                "leave one of them out"
            )
        if self.error_stats is not None and self.error not in MEASURED_ERRORS:
            raise RequestError(
                f"error_stats '{self.error_stats}' goes with the errors "
                f"{', '.join(MEASURED_ERRORS)}, not with '{self.error}'; leave it out"
            )
        if not isinstance(self.error_stats, str | None):
            raise RequestError(f"error_stats {self.error_stats!r}: must be the path of a file")
        if self.error_stats is not None:
            require_printable("error_stats", self.error_stats, 4096)
        require_integer("delay", self.delay, 0, MAX_DELAY, " frames of 1/30 s")
        require_integer("corruption_seed", self.seed, 0, MAX_SEED)
        for name in ("face_dropout", "face_dropout_length", "detector_rate"):
            value = getattr(self, name)
            if not (_is_number(value) or (name == "detector_rate" and value is None)):
                raise RequestError(f"{name} {value!r}: must be a number")
        require_ranges(self)
        length = self.face_dropout_length
        # Losses of that length, however close together, leave at least one frame between them.
        most = length / (length + 1.0)
        if self.face_dropout > most:
            raise RequestError(
                f"face_dropout {self.face_dropout:g}: must be 0 to {most:.3g}, the share of frames "
                f"in which the face is lost, with losses of {length:g} frames"
            )

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Corruption:
        """Build one from its fields, as JSON holds them.

        Raises:
            RequestError: a value or a name is not valid.
        """
        return convert(dict(values), cls, "corruption")

    def __bool__(self) -> bool:
        """Return whether anything is corrupted."""
        return self.has_forecast_error or bool(
            self.delay or self.face_dropout or self.detector_rate
        )

    @property
    def has_forecast_error(self) -> bool:
        """True if another future than the true one is observed."""
        return (self.error, self.prediction) != ("none", "truth")

    @property
    def label(self) -> str:
        """Name for conditions and folders, such as ``uniform_delay3``."""
        parts = []
        if self.error != "none":
            stem = f"_{Path(self.error_stats).stem}" if self.error_stats else ""
            parts.append(f"{self.error}{stem}")
        if self.prediction != "truth":
            parts.append(self.prediction)
        if self.delay:
            parts.append(f"delay{self.delay}")
        if self.face_dropout:
            length = self.face_dropout_length
            suffix = f"x{length:g}" if length != DROPOUT_LENGTH else ""
            parts.append(f"dropout{self.face_dropout:g}{suffix}")
        if self.detector_rate is not None:
            parts.append(f"rate{self.detector_rate:g}")
        if self.seed:
            parts.append(f"draw{self.seed}")
        return "_".join(parts)

    def __str__(self) -> str:
        """List what differs from the defaults, in the names of the options."""
        changed = [
            f"{item.name} {value[:12] if item.name == 'stats_sha256' else value}"
            for item in fields(self)
            if (value := getattr(self, item.name)) != item.default
        ]
        return ", ".join(changed) or "no corruption"

    def pinned(self) -> Corruption:
        """Return the same with the SHA-256 of its file of statistics, if it uses one.

        Raises:
            RequestError: the file cannot be used, or is not the one of ``stats_sha256``.
        """
        if self.error not in MEASURED_ERRORS:
            return self
        stats = load_error_stats(self.error_stats, self.stats_sha256)
        return replace(self, stats_sha256=stats.sha256)

    def is_same_as(self, other: Corruption) -> bool:
        """Return whether both corrupt alike; statistics count by digest, not by path."""
        if not (self or other):
            return True
        return replace(self, error_stats=None) == replace(other, error_stats=None)


@dataclass(frozen=True)
class DetectionTiming:
    """Moment of the past that is observed at each moment of an episode.

    Attributes:
        delay: s.
        rate: detections a second; None for one at every moment.
        last_found: (F,) the last frame, up to each, in which the face was found.
        last_detection: (J,) the last detection, up to each, that found it; empty without a rate.
    """

    delay: float
    rate: float | None
    last_found: NDArray[np.int64]
    last_detection: NDArray[np.int64]

    @classmethod
    def of(cls, corruption: Corruption, lost: NDArray[np.bool_]) -> DetectionTiming:
        """Lay out an episode of F frames, in some of which, (F,), the face is lost."""
        last_found = np.maximum.accumulate(np.where(lost, 0, np.arange(len(lost))))
        rate, last_detection = corruption.detector_rate, np.zeros(0, np.int64)
        if rate is not None:
            detections = np.arange(int(frame_of(len(lost) / FRAME_RATE, rate)) + 1)
            is_lost = lost[np.minimum(frame_of(detections / rate), len(lost) - 1)]
            last_detection = np.maximum.accumulate(np.where(is_lost, 0, detections))
        return cls(corruption.delay / FRAME_RATE, rate, last_found, last_detection)

    def seen_at(self, time: ArrayLike) -> tuple[Floats, NDArray[np.int64]]:
        """Return when the target observed at ``time`` was seen, and in which video frame.

        Before the first detection can have arrived, the first one is observed. A delay of 3 frames
        without anything else, at 30 steps a second, the content of step n being n::

            step      0 1 2 3 4 5
            observed  0 0 0 0 1 2

        Args:
            time: (...) s since the start of the episode, no later than frame F - 1 lasts.

        Returns:
            (...) s, never later than ``time``, and (...) the frame whose error it has.
        """
        seen = np.maximum(np.asarray(time, dtype=np.float64) - self.delay, 0.0)
        if self.rate is not None:
            detection = self.last_detection[frame_of(seen, self.rate)] / self.rate
            return np.minimum(detection, seen), frame_of(detection)
        frame = frame_of(seen)
        found = self.last_found[frame]
        # While the face is lost, the last sight of it is held.
        held = np.minimum((found + 1) / FRAME_RATE, seen)
        return np.where(found < frame, held, seen), found

    def seen_now(self, time: float) -> tuple[float, int]:
        """Return what `seen_at` does of one moment; Python's numbers are faster one by one."""
        seen = max(time - self.delay, 0.0)
        if self.rate is not None:
            detection = float(self.last_detection[_frame_now(seen, self.rate)]) / self.rate
            return min(detection, seen), _frame_now(detection)
        frame = _frame_now(seen)
        found = int(self.last_found[frame])
        return min((found + 1) / FRAME_RATE, seen) if found < frame else seen, found


_Draws = tuple[Floats | None, DetectionTiming]
"""Random draws of an episode: errors (F, H, 3) m, world, or None; and the timing."""


class CorruptionPipeline:
    """Corrupts the target step by step, or over a whole recorded episode, to the same numbers.

    Args:
        corruption: settings.
        horizon: frames ahead that will be observed.
        past: frames ago, P, at which what was reported then will be observed, too.

    Raises:
        RequestError: the file of error statistics cannot be used.
    """

    def __init__(self, corruption: Corruption, horizon: int = 0, past: int = 0) -> None:
        self.corruption, self.horizon, self.past = corruption, horizon, past
        self._draw_error: Draw | None = None
        if corruption.error in MEASURED_ERRORS:
            stats = load_error_stats(corruption.error_stats, corruption.stats_sha256)
            stats.require_horizon(horizon)
            self._draw_error = DRAWN_ERRORS[corruption.error](stats)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Start the episode of this seed."""
        self._seed = seed
        self._draws = self._draw(seed, _FIRST_FRAMES)
        self._steps = 0
        self._known: list[Floats] = []  # time, target and, if there is one, predicted target

    def observe(self, state: State) -> TargetObservation:
        """Return the observed target of one step, from its state and those given before.

        A step is later than the one before, or the same once more.

        Raises:
            RequestError: a predicted target is to be observed, and there is none.
        """
        self._append(state)
        time, position, *predicted = (known[: self._steps] for known in self._known)
        now = float(time[-1])
        frames = _frame_now(now) + 1
        if frames > len(self._draws[1].last_found):
            self._draws = self._draw(self._seed, 2 * frames)
        forecast = predicted[0] if predicted else None
        if not self.past:
            return self._report_now(self._draws, time, position, forecast, now)
        observed = self._observe_at(self._draws, time, position, forecast, time[-1:])
        past = None if observed.past is None else observed.past[0]
        return TargetObservation(observed.time[0], observed.position[0], past)

    def observe_episode(self, state: State, seed: int) -> TargetObservation:
        """Return the observed target at every step, (T, ...), as `observe` would have.

        Raises:
            RequestError: a predicted target is to be observed, and there is none.
        """
        draws = self._draw(seed, int(frame_of(state.time[-1])) + 1)
        return self._observe_at(
            draws, state.time, state.target_position, state.predicted_target, state.time
        )

    def _observe_at(
        self, draws: _Draws, time: Floats, position: Floats, predicted: Floats | None, now: Floats
    ) -> TargetObservation:
        """Observe at the moments ``now`` (n,) s, and P frames before each, see `_report_at`."""
        if not self.past:
            return self._report_at(draws, time, position, predicted, now)
        # Before the episode, what was reported at its first moment.
        moments = np.maximum(now[:, None] - np.arange(self.past + 1) * FRAME_PERIOD, time[0])
        report = self._report_at(draws, time, position, predicted, moments.ravel())
        seen = report.time.reshape(moments.shape)
        track = report.position.reshape(*moments.shape, *report.position.shape[1:])
        return TargetObservation(seen[:, 0], track[:, 0], track[:, 1:, 0])

    def _report_at(
        self, draws: _Draws, time: Floats, position: Floats, predicted: Floats | None, now: Floats
    ) -> TargetObservation:
        """Return the report at the moments ``now`` (n,) s, from the states of the T steps ``time``.

        Of steps later than a moment nothing is used at that moment.
        """
        error, timing = draws
        seen, error_frame = timing.seen_at(now)
        row = np.searchsorted(time, seen + _TIME_ROUNDING, side="right") - 1
        after = np.minimum(row + 1, len(time) - 1)
        late = seen - time[row]
        between = late > _TIME_ROUNDING
        part = np.divide(late, time[after] - time[row], out=np.zeros_like(late), where=between)
        part = part[:, None, None]
        mixed = (1.0 - part) * position[row] + part * position[after]
        observed = np.where(part > 0.0, mixed, position[row])  # a step itself: bit for bit
        late = np.where(between, late, 0.0)
        self._corrupt(observed, error, time, position, predicted, (row, late, error_frame))
        return TargetObservation(seen, observed)

    def _report_now(
        self, draws: _Draws, time: Floats, position: Floats, predicted: Floats | None, now: float
    ) -> TargetObservation:
        """Return what `_report_at` does of one moment, to the same numbers, and faster."""
        error, timing = draws
        seen, error_frame = timing.seen_now(now)
        row = int(time.searchsorted(seen + _TIME_ROUNDING, side="right")) - 1
        late = seen - float(time[row])
        if late > _TIME_ROUNDING:
            after = min(row + 1, len(time) - 1)
            part = late / float(time[after] - time[row])
            observed = (1.0 - part) * position[row] + part * position[after]
        else:
            late, observed = 0.0, position[row].copy()
        at = np.array([row]), np.array([late]), np.array([error_frame])
        self._corrupt(observed[None], error, time, position, predicted, at)
        return TargetObservation(np.asarray(seen), observed)

    def _corrupt(
        self,
        observed: Floats,
        error: Floats | None,
        time: Floats,
        position: Floats,
        predicted: Floats | None,
        at: tuple[NDArray[np.int64], Floats, NDArray[np.int64]],
    ) -> None:
        """Put errors or forecasts into observed targets (n, K, 3).

        ``at`` are (n,) the step at which each was seen, the s after it, and the frame of its error.
        """
        row, late, error_frame = at
        if error is not None:
            ahead = min(error.shape[1], observed.shape[1] - 1)
            observed[:, 1 : ahead + 1] += error[error_frame, :ahead]
        elif self.corruption.prediction != "truth":
            if predicted is None:
                raise ValueError("a forecaster's output is to be observed, and the state has none")
            made = np.concatenate([position[row, :1], predicted[row]], axis=1)
            observed[:, 1:] = _read_off(made, late / FRAME_PERIOD, observed.shape[1])[:, 1:]
        elif self.corruption.error == "model":
            frames = 0 if predicted is None else predicted.shape[1]
            if problem := prediction_problem(frames, self.horizon):
                raise RequestError(f"the state holds {problem}")
            assert predicted is not None
            # The error that the predictor made in a video frame lasts until the next.
            made = np.searchsorted(time, error_frame / FRAME_RATE - _TIME_ROUNDING)
            ahead = slice(1, min(frames + 1, position.shape[1]))
            observed[:, ahead] += predicted[made, : ahead.stop - 1] - position[made, ahead]

    def _append(self, state: State) -> None:
        given = (state.time, state.target_position, state.predicted_target)
        values = [value for value in given if value is not None]
        if not self._known or self._steps == len(self._known[0]):
            more = max(self._steps, _FIRST_STEPS)
            room = [np.empty((more, *np.shape(value))) for value in values]
            pairs = zip(self._known or [array[:0] for array in room], room, strict=True)
            self._known = [np.concatenate(pair) for pair in pairs]
        for known, value in zip(self._known, values, strict=True):
            known[self._steps] = value
        self._steps += 1

    def _draw(self, seed: int, frames: int) -> _Draws:
        corruption, error = self.corruption, None
        if self._draw_error:
            rng = _stream(corruption.seed, seed, "error")
            error = self._draw_error(rng, frames) @ WORLD_FROM_IMAGE
        lost = draw_lost(corruption, _stream(corruption.seed, seed, "lost"), frames)
        return error, DetectionTiming.of(corruption, lost)


def _read_off(made: Floats, late: Floats, count: int) -> Floats:
    """Return forecasts ``late`` frames after they were made, (n, count, 3) m.

    Each is interpolated between two horizons, the last one prolonged: nothing that came after the
    forecast is used.

    Args:
        made: (n, H + 1, 3) m, forecasts of 0 ... H frames ahead.
        late: (n,) frames, less than 1.
        count: of horizons, from 0 on, at most H + 1.
    """
    moves = np.diff(made, axis=1)[:, np.minimum(np.arange(count), made.shape[1] - 2)]
    return made[:, :count] + late[:, None, None] * moves


def prediction_problem(frames: int, horizon: int) -> str:
    """Return why a predictor's output cannot be observed with the error ``model``, or "".

    Args:
        frames: that the output looks ahead; 0 for none at all.
        horizon: frames that are to be observed.

    Returns:
        End of a message that says what a library or an episode "holds".
    """
    if not frames:
        return (
            "no predicted mouth, which the error 'model' shows; use a motion library that "
            "'python -m face_prediction predict' wrote, or choose another error"
        )
    if horizon > frames:
        return (
            f"the predicted mouth {frames} frames ahead, not {horizon}; choose a horizon up to "
            f"{frames}, a motion library with longer predictions, or another error"
        )
    return ""


def frame_of(time: ArrayLike, rate: float = FRAME_RATE) -> NDArray[np.int64]:
    """Return the number of the last frame, the first being 0, that was taken by ``time`` (s)."""
    return np.floor(np.asarray(time) * rate + _FRAME_ROUNDING).astype(np.int64)


def _frame_now(time: float, rate: float = FRAME_RATE) -> int:
    """Return what `frame_of` does of one time."""
    return math.floor(time * rate + _FRAME_ROUNDING)


def draw_lost(corruption: Corruption, rng: np.random.Generator, frames: int) -> NDArray[np.bool_]:
    """Draw the frames, (F,), in which the face is lost; never the first.

    A loss lasts a geometrically distributed number of frames; how often one begins follows from the
    share of frames that are lost in the long run.
    """
    lost = np.zeros(frames, np.bool_)
    if not corruption.face_dropout:
        return lost
    length = corruption.face_dropout_length
    begins = corruption.face_dropout / ((1.0 - corruption.face_dropout) * length)
    for frame, chance in enumerate(rng.random(frames).tolist()[1:], start=1):
        lost[frame] = chance >= 1.0 / length if lost[frame - 1] else chance < begins
    return lost


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _stream(seed: int, episode: int, name: str) -> np.random.Generator:
    """Return the generator of a named stream of an episode, the same for every condition."""
    return np.random.default_rng(np.random.SeedSequence([seed, episode, *name.encode()]))
