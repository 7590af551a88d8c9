"""What everything that forecasts faces offers to those who judge it, export it or run it live.

Coordinates are normalised to the square crop of a sequence: u right and v down, 0 to 1.
Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the pictures,
P pictures at the end of the history.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PictureNeeds:
    """Which pictures of a history a predictor looks at: the last ``frames``, of side ``size``."""

    #: 0: none
    frames: int
    #: pixels; 256, or a half, a quarter or an eighth of it
    size: int


@dataclass(frozen=True)
class Forecast:
    """What is forecast for the H frames after each of B histories."""

    #: (B, H, L, 2) float32; NaN where there is no forecast
    landmarks: NDArray[np.float32]
    #: (B, H, S, S, 3) uint8 RGB; None: this predictor makes no pictures
    pictures: NDArray[np.uint8] | None = None
    #: (B, H, 2) scale of the error of the mouth centre along U and V; None: it gives no intervals
    mouth_scale: NDArray[np.float32] | None = None
    #: (H, 2) degrees of freedom of that Student-t error; infinite: a Gaussian
    degrees_of_freedom: NDArray[np.float64] | None = None


class Predictor(Protocol):
    """Anything that forecasts: a baseline, or a trained network."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def memory(self) -> int | None:
        """Frames of landmarks at the end of the history that count; None: all of them."""
        ...

    @property
    def needs(self) -> PictureNeeds:
        """Which pictures it looks at."""
        ...

    def predict(
        self,
        landmarks: NDArray[np.floating],
        pictures: NDArray[np.uint8] | None,
        horizon: int,
    ) -> Forecast:
        """Forecast ``horizon`` frames.

        Args:
            landmarks: (B, T, L, 2), the newest last, 30 a second.
            pictures: (B, P, S, S, 3) uint8 RGB of the last P frames, as `needs` says; None where
                it needs none.
            horizon: 1 or more; a trained network has a longest one.

        Raises:
            RequestError: a shape is another one, or the horizon is too long.
        """
        ...
