"""The forecast that nothing moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import Array, Forecaster, LandmarkSequences
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class Persistence(Forecaster):
    """Every future frame is the last one seen."""

    name = "persistence"

    @classmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Nothing is fitted."""
        return cls()

    @property
    def memory(self) -> int:
        """The last frame."""
        return 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        return np.repeat(history[:, -1:].astype(np.float64), horizon, axis=1)


@dataclass(frozen=True)
class ConstantVelocity(Forecaster):
    """From where it is, each landmark goes on as from ``window`` frames ago until now.

    velocity = (last frame - frame ``window`` before it) / window, in crops a frame; with fewer
    frames the whole history is the window, and one frame has velocity 0.
    """

    #: frames the velocity is taken over; 1 is the last step alone
    window: int = 1

    name = "constant_velocity"

    def __post_init__(self) -> None:
        if self.window < 1:
            raise RequestError(f"constant_velocity: window {self.window}; must be 1 or more frames")

    @classmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Nothing is fitted."""
        return cls()

    @property
    def memory(self) -> int:
        """The window and the last frame."""
        return self.window + 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        last = history[:, -1].astype(np.float64)
        velocity = (last - history[:, 0]) / max(history.shape[1] - 1, 1)
        return last[:, None] + _ahead(horizon) * velocity[:, None]


@dataclass(frozen=True)
class Line(Forecaster):
    """The least-squares line through each landmark's last ``frames`` frames, prolonged.

    It smooths where the landmark is now as well as how fast it goes; one frame has velocity 0.
    """

    frames: int = 5

    name = "line"

    def __post_init__(self) -> None:
        if self.frames < 2:
            raise RequestError(f"line: {self.frames} frames; must be 2 or more")

    @classmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Nothing is fitted: it is the rule of thumb that needs no data."""
        return cls()

    @property
    def memory(self) -> int:
        """The frames of the line."""
        return self.frames

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        frames = history.shape[1]
        time = np.arange(frames) - (frames - 1) / 2  # about the middle of the line
        spread = float(time @ time) or 1.0  # one frame: no spread, and no velocity
        velocity = np.einsum("t,btlc->blc", time / spread, history)
        middle = history.mean(axis=1, dtype=np.float64)
        return middle[:, None] + ((frames - 1) / 2 + _ahead(horizon)) * velocity[:, None]


def _ahead(horizon: int) -> NDArray[np.float64]:
    """Frames ahead, 1 to H, as (1, H, 1, 1)."""
    return np.arange(1.0, horizon + 1)[None, :, None, None]
