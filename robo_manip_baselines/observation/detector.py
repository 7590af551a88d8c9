"""From truth to what is reported of the mouth: ``truth -> predict -> error -> delay -> dropout``.

Legend: T control steps, K = 6 frames from now to the longest horizon, H horizons of the error, F
video frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.observation.corruption import FRAME_RATE, MEASURED_ERRORS, Corruption
from robo_manip_baselines.observation.error_models import DRAWN_ERRORS, WORLD_FROM_IMAGE, Draw
from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.observation.spec import ObservationSpec
from robo_manip_baselines.observation.state import Report, Truth
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

_FIRST_FRAMES = 512
"""Frames drawn when an episode starts, 17 s; a longer episode draws on."""

_FIRST_STEPS = 1024
"""Steps that there is room for when an episode starts; a longer one makes room."""

_ROUNDING = 1e-7
"""s by which times that are meant to be the same may differ."""

NO_PREDICTION = (
    "no predicted mouth, which the error 'model' shows; use a motion library that "
    "'python -m face_prediction predict' wrote, or choose another error"
)
"""What is said where there is none; the name of the thing that holds it comes first."""


@dataclass(frozen=True)
class _Drawn:
    """What is drawn for an episode: errors (F, H, 3) m, world, or None; and when what is seen."""

    frames: int
    error: Floats | None
    schedule: Schedule


class Detector:
    """Reports the mouth step by step, or for a whole recorded episode; the numbers are the same.

    Args:
        corruption: what to do to the truth.
        horizon: frames ahead that are to be shown.

    Raises:
        RequestError: the file of error statistics cannot be used.
    """

    def __init__(self, corruption: Corruption, horizon: int = 0) -> None:
        self.corruption = corruption
        self._draw_error: Draw | None = None
        if corruption.error in MEASURED_ERRORS:
            stats = load_error_stats(corruption.error_stats, corruption.stats_sha256)
            if horizon > stats.horizons:
                raise RequestError(
                    f"error statistics '{stats.source}' go {stats.horizons} frames ahead; choose "
                    f"a horizon up to that, not {horizon}, or other statistics"
                )
            self._draw_error = DRAWN_ERRORS[corruption.error](stats)
        self.reset(0)

    @classmethod
    def of(cls, spec: ObservationSpec) -> Detector | None:
        """Return the detector that a spec asks for; None where the truth is shown."""
        return spec.corruption and cls(spec.corruption, spec.frames - 1)

    def reset(self, seed: int) -> None:
        """Start the episode of this seed."""
        self._seed = seed
        self._drawn = self._draw(seed, _FIRST_FRAMES)
        self._known = 0
        self._time = np.empty(0)
        self._mouth = np.empty((0, 0, 3))
        self._predicted = np.empty((0, 0, 3))

    def report(self, truth: Truth) -> Report:
        """Return what is reported now, given what is so now and was given to this before.

        Args:
            truth: of one step, later than the step before (or the same once more).

        Raises:
            RequestError: the error needs a predicted mouth, and there is none.
        """
        self._remember(truth)
        time = self._time[: self._known]
        frames = int(frame_of(time[-1])) + 1
        if frames > self._drawn.frames:
            self._drawn = self._draw(self._seed, 2 * frames)
        report = self._look(
            self._drawn,
            time,
            self._mouth[: self._known],
            None if truth.predicted_mouth is None else self._predicted[: self._known],
            time[-1:],
        )
        return Report(report.time[0], report.mouth[0])

    def report_episode(self, truth: Truth, seed: int) -> Report:
        """Return what is reported at every step of an episode, as `report` would have.

        Args:
            truth: of the whole episode, (T, ...).
            seed: of the episode.

        Raises:
            RequestError: the error needs a predicted mouth, and there is none.
        """
        drawn = self._draw(seed, int(frame_of(truth.time[-1])) + 1)
        return self._look(
            drawn, truth.time, truth.mouth_position, truth.predicted_mouth, truth.time
        )

    def _look(
        self, drawn: _Drawn, time: Floats, mouth: Floats, predicted: Floats | None, now: Floats
    ) -> Report:
        """Report at the moments ``now`` (n,) s, out of what is so at the T steps ``time``.

        Of every step later than a moment nothing is used at that moment.
        """
        seen, error_frame = drawn.schedule.seen_at(now)
        row = np.searchsorted(time, seen + _ROUNDING, side="right") - 1
        after = np.minimum(row + 1, len(time) - 1)
        late = seen - time[row]
        between = late > _ROUNDING
        part = np.divide(late, time[after] - time[row], out=np.zeros_like(late), where=between)
        part = part[:, None, None]
        # What was seen at a step itself is reported bit for bit.
        shown = np.where(part > 0.0, (1.0 - part) * mouth[row] + part * mouth[after], mouth[row])
        if drawn.error is not None:
            ahead = min(drawn.error.shape[1], shown.shape[1] - 1)
            shown[:, 1 : ahead + 1] += drawn.error[error_frame, :ahead]
        elif self.corruption.error == "model":
            if predicted is None:
                raise RequestError(f"there is {NO_PREDICTION}")
            # The error that the predictor made in a video frame lasts until the next.
            made = np.searchsorted(time, error_frame / FRAME_RATE - _ROUNDING)
            shown[:, 1:] += predicted[made] - mouth[made, 1:]
        return Report(seen, shown)

    def _remember(self, truth: Truth) -> None:
        """Add a step to those that are known."""
        if self._known == len(self._time):
            more = max(self._known, _FIRST_STEPS)
            self._time = _grown(self._time, (), self._known, more)
            self._mouth = _grown(self._mouth, truth.mouth_position.shape, self._known, more)
            if truth.predicted_mouth is not None:
                shape = truth.predicted_mouth.shape
                self._predicted = _grown(self._predicted, shape, self._known, more)
        self._time[self._known] = truth.time
        self._mouth[self._known] = truth.mouth_position
        if truth.predicted_mouth is not None:
            self._predicted[self._known] = truth.predicted_mouth
        self._known += 1

    def _draw(self, seed: int, frames: int) -> _Drawn:
        corruption = self.corruption
        error = None
        if self._draw_error:
            rng = _stream(corruption.seed, seed, "error")
            error = self._draw_error(rng, frames) @ WORLD_FROM_IMAGE
        lost = draw_lost(corruption, _stream(corruption.seed, seed, "lost"), frames)
        return _Drawn(frames, error, Schedule.of(corruption, lost))


def _stream(seed: int, episode: int, name: str) -> np.random.Generator:
    """Return the generator of a named stream of an episode, the same for every arm."""
    return np.random.default_rng(np.random.SeedSequence([seed, episode, *name.encode()]))


def _grown(rows: Floats, shape: tuple[int, ...], known: int, more: int) -> Floats:
    """Return (known + more, *shape), the first of them as in ``rows``."""
    larger = np.empty((known + more, *shape))
    if known:
        larger[:known] = rows[:known]
    return larger


_ROUNDING_schedule = 1e-6
"""Frames by which a time may fall short of a frame and still belong to it."""


def frame_of(time: ArrayLike, rate: float = FRAME_RATE) -> NDArray[np.int64]:
    """Return the number of the last frame, the first being 0, that was taken by ``time`` (s)."""
    return np.floor(np.asarray(time) * rate + _ROUNDING_schedule).astype(np.int64)


def draw_lost(corruption: Corruption, rng: np.random.Generator, frames: int) -> NDArray[np.bool_]:
    """Draw in which frames, (F,), the face is lost; never in the first.

    A loss lasts a geometrically distributed number of frames; how often one begins follows from the
    share of frames that are lost in the long run.
    """
    if not corruption.face_dropout:
        return np.zeros(frames, np.bool_)
    length = corruption.face_dropout_length
    begins = corruption.face_dropout / ((1.0 - corruption.face_dropout) * length)
    lost = np.zeros(frames, np.bool_)
    for frame, chance in enumerate(rng.random(frames).tolist()[1:], start=1):
        lost[frame] = chance >= 1.0 / length if lost[frame - 1] else chance < begins
    return lost


@dataclass(frozen=True)
class Schedule:
    """Which moment of the past each moment of an episode is shown.

    Attributes:
        delay: s.
        rate: reports a second; None for one at every moment.
        last_found: (F,) the last frame, up to each, in which the face was found.
        last_look: (J,) the last look, up to each, that found it; without a rate, none.
    """

    delay: float
    rate: float | None
    last_found: NDArray[np.int64]
    last_look: NDArray[np.int64]

    @classmethod
    def of(cls, corruption: Corruption, lost: NDArray[np.bool_]) -> Schedule:
        """Lay out the schedule of an episode of F frames, in some of which the face is lost."""
        last_found = np.maximum.accumulate(np.where(lost, 0, np.arange(len(lost))))
        rate, last_look = corruption.detector_rate, np.zeros(0, np.int64)
        if rate is not None:
            looks = np.arange(int(frame_of(len(lost) / FRAME_RATE, rate)) + 1)
            is_lost = lost[np.minimum(frame_of(looks / rate), len(lost) - 1)]
            last_look = np.maximum.accumulate(np.where(is_lost, 0, looks))
        return cls(corruption.delay / FRAME_RATE, rate, last_found, last_look)

    def seen_at(self, time: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return when what is shown at ``time`` was seen, and in which video frame.

        Before the first report can have arrived, the first report is shown. A delay of 3 frames
        without anything else, at 30 steps a second, the content of step n being n::

            step   0 1 2 3 4 5
            shown  0 0 0 0 1 2

        Args:
            time: (...) s since the start of the episode, no later than frame F - 1 lasts.

        Returns:
            (...) s, never later than ``time``, and (...) the frame whose error it has.
        """
        seen = np.maximum(np.asarray(time, dtype=np.float64) - self.delay, 0.0)
        if self.rate is not None:
            look = self.last_look[frame_of(seen, self.rate)] / self.rate
            return np.minimum(look, seen), frame_of(look)
        frame = frame_of(seen)
        found = self.last_found[frame]
        # While the face is lost, what was seen when it got lost is held.
        held = np.minimum((found + 1) / FRAME_RATE, seen)
        return np.where(found < frame, held, seen), found
