"""Landmarks of a predictor that makes pictures only: what a face detector finds in them.

Legend: B histories, H horizon, L = 468 landmarks, S side of the pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.detector import FaceDetection
from face_prediction.predictor import Forecast, PictureNeeds, Predictor
from face_prediction.tracks import NUM_LANDMARKS

#: Pictures are enlarged to at least this side (pixels), the one that the detector's second network
#: looks at: what it does itself with a small picture loses more (the mouth of 64-pixel crops is
#: found within 0.002 of a crop instead of 0.006).
DETECTOR_SIDE = 256


class Detector(Protocol):
    """What is asked of `face_prediction.detector.FaceDetector`."""

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        """Faces in ``image`` (H, W, 3) uint8 RGB."""
        ...


@dataclass(frozen=True)
class DetectedPredictor:
    """A predictor without landmarks of its own, whose pictures are looked at by a detector.

    Where no face is found the landmarks are NaN: a missing forecast.
    """

    predictor: Predictor
    detector: Detector

    @property
    def name(self) -> str:
        """The predictor's."""
        return self.predictor.name

    @property
    def memory(self) -> int | None:
        """The predictor's."""
        return self.predictor.memory

    @property
    def needs(self) -> PictureNeeds:
        """The predictor's."""
        return self.predictor.needs

    def predict(
        self,
        landmarks: NDArray[np.floating],
        pictures: NDArray[np.uint8] | None,
        horizon: int,
    ) -> Forecast:
        """Forecast pictures, and find the face in each; see `Predictor`."""
        forecast = self.predictor.predict(landmarks, pictures, horizon)
        if forecast.pictures is None:
            return forecast
        return replace(forecast, landmarks=find_landmarks(forecast.pictures, self.detector))


def find_landmarks(pictures: NDArray[np.uint8], detector: Detector) -> NDArray[np.float32]:
    """Landmarks (B, H, L, 2) in pictures (B, H, S, S, 3), normalised to them; NaN without a face.

    Of several faces the largest counts.
    """
    result = np.full((*pictures.shape[:2], NUM_LANDMARKS, 2), np.nan, dtype=np.float32)
    for place in np.ndindex(result.shape[:2]):
        faces = detector.detect(_enlarged(pictures[place]), 0.0)
        if faces:
            result[place] = max((face.landmarks for face in faces), key=_height)[:, :2]
    return result


def _enlarged(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``picture`` (S, S, 3) at the detector's size, unless it is as large."""
    import cv2  # not needed unless pictures are looked at

    if picture.shape[0] >= DETECTOR_SIDE:
        return picture
    size = (DETECTOR_SIDE, DETECTOR_SIDE)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def _height(landmarks: np.ndarray) -> float:
    return float(np.ptp(landmarks[:, 1]))
