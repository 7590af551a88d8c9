"""A baseline forecaster in the place of a trained network.

Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.forecast import Forecaster
from face_prediction.predictor import Forecast, PictureNeeds


@dataclass(frozen=True)
class BaselinePredictor:
    """Forecasts landmarks as ``forecaster`` does, and pictures as copies of the last one.

    Attributes:
        forecaster: a fitted baseline.
        picture_size: side of the pictures that are copied; 0: it makes none.
    """

    forecaster: Forecaster
    picture_size: int = 0

    @property
    def name(self) -> str:
        """The forecaster's."""
        return self.forecaster.name

    @property
    def memory(self) -> int | None:
        """The forecaster's."""
        return self.forecaster.memory

    @property
    def needs(self) -> PictureNeeds:
        """The last picture, where it is to be copied."""
        return PictureNeeds(frames=1 if self.picture_size else 0, size=self.picture_size)

    def predict(
        self,
        landmarks: NDArray[np.floating],
        pictures: NDArray[np.uint8] | None,
        horizon: int,
    ) -> Forecast:
        """Forecast ``horizon`` frames; see `Predictor`.

        Raises:
            RequestError: a shape is another one, or the horizon is 0 or less.
        """
        if landmarks.ndim != 4:
            raise RequestError(f"landmarks of shape {landmarks.shape}; expected (B, T, 468, 2)")
        forecast = self.forecaster.predict(landmarks, horizon).astype(np.float32, copy=False)
        if not self.picture_size:
            return Forecast(forecast)
        expected = (len(landmarks), 1, self.picture_size, self.picture_size, 3)
        if pictures is None or pictures.shape != expected:
            given = None if pictures is None else pictures.shape
            raise RequestError(f"{self.name}: pictures of shape {given}; expected {expected}")
        return Forecast(forecast, np.repeat(pictures, horizon, axis=1))
