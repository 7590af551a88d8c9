"""Interface of predictors of faces, which are evaluated, exported or run live.

Coordinates are normalised to the square crop of a sequence: u right and v down, 0 to 1.
Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the images,
P images at the end of the history.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ImageNeeds:
    """Images of the history that a predictor needs.

    Attributes:
        frames: how many, from the end of the history; 0: none.
        size: their side in pixels; 256, or a half, a quarter or an eighth of it.
    """

    frames: int
    size: int


@dataclass(frozen=True)
class Forecast:
    """Forecast of the H frames after each of B histories.

    Attributes:
        landmarks: (B, H, L, 2) float32; NaN where there is no forecast.
        images: (B, H, S, S, 3) uint8 RGB; None: the predictor makes no images.
        mouth_scale: (B, H, 2) scale of the error of the mouth centre along U and V; None: the
            predictor gives no intervals.
        degrees_of_freedom: (H, 2) degrees of freedom of that Student-t error; infinite: a Gaussian.
    """

    landmarks: NDArray[np.float32]
    images: NDArray[np.uint8] | None = None
    mouth_scale: NDArray[np.float32] | None = None
    degrees_of_freedom: NDArray[np.float64] | None = None


class Predictor(Protocol):
    """A baseline or a trained network that forecasts faces."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    @property
    def memory(self) -> int | None:
        """Frames of landmarks at the end of the history that count; None: all of them."""
        ...

    @property
    def needs(self) -> ImageNeeds:
        """Images of the history that it needs."""
        ...

    def predict(
        self, landmarks: NDArray[np.floating], images: NDArray[np.uint8] | None, horizon: int
    ) -> Forecast:
        """Forecast ``horizon`` frames.

        Args:
            landmarks: (B, T, L, 2), the newest last, 30 a second.
            images: (B, P, S, S, 3) uint8 RGB of the last P frames, see `needs`; None where it
                needs none.
            horizon: 1 or more; a trained network has a longest one.

        Raises:
            RequestError: a shape is another one, or the horizon is too long.
        """
        ...
