"""Interface of predictors of faces, which are evaluated, exported or run live.

Coordinates are normalised to the square crop of a sequence: u right and v down, 0 to 1.
Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the images,
P images at the end of the history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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
        degrees_of_freedom: (H, 2) degrees of freedom of that Student-t error, or (B, H, 2) where
            they differ between histories; infinite: a Gaussian.
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


@dataclass(frozen=True)
class TrackForecast:
    """Forecasts of the mouth centre from every frame of a track, in the unit of its landmarks.

    Attributes:
        mouth: (T, H, 2) displacement from each frame to the frames after it.
        scale: (T, H, 2) scale of its Student-t error; None: the predictor gives no intervals.
        degrees_of_freedom: (T, H, 2) of that error.
    """

    mouth: NDArray[np.float64]
    scale: NDArray[np.float64] | None = None
    degrees_of_freedom: NDArray[np.float64] | None = None


class FaceFollower(Protocol):
    """State of a predictor that lives as long as one face is watched."""

    def update(self, landmarks: NDArray[np.floating]) -> None:
        """Take in the next frame, (L, 2), a frame period after the one before."""
        ...

    def forecast(self, recent: NDArray[np.floating], horizon: int) -> NDArray[np.floating]:
        """Forecast (H, L, 2) from what was learnt, and the last frames ``recent`` (W, L, 2).

        These are a frame period apart, the newest last; they need not be those that were taken in.
        """
        ...


@runtime_checkable
class StatefulPredictor(Predictor, Protocol):
    """A predictor that keeps learning from a face for as long as it is watched.

    Attributes:
        recent: W, frames that a forecast is made from, beside what was learnt.
    """

    recent: int

    def forecast_tracks(
        self, tracks: Sequence[NDArray[np.floating]], horizon: int
    ) -> list[TrackForecast]:
        """Forecast the mouth from every frame of tracks (T, L, 2), by the frames up to it.

        The unit of the landmarks is that of an image that stands still, the same along both axes.
        """
        ...

    def follow(self) -> FaceFollower:
        """Return the state of a face that is seen for the first time."""
        ...
