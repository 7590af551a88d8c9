"""When what the policy is shown was seen: delay, lost faces, and the rate of the detector.

Legend: F video frames, J looks of the detector, ... any shape of times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.observation.corruption import FRAME_RATE, Corruption

_ROUNDING = 1e-6
"""Frames by which a time may fall short of a frame and still belong to it."""


def frame_of(time: ArrayLike, rate: float = FRAME_RATE) -> NDArray[np.int64]:
    """Return the number of the last frame, the first being 0, that was taken by ``time`` (s)."""
    return np.floor(np.asarray(time) * rate + _ROUNDING).astype(np.int64)


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
