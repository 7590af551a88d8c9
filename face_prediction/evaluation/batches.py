"""Landmarks and pictures of some sequences at once, each picture decoded once for all predictors.

Legend: B sequences, T frames of history, H horizon, L = 468 landmarks, P pictures, S their side.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import reduction
from face_prediction.dataset.reader import FaceDataset
from face_prediction.prediction.interface import Forecast, PictureNeeds, Predictor
from face_prediction.tracking.detector import FaceDetection
from face_prediction.tracking.tracks import NUM_LANDMARKS


@dataclass(frozen=True)
class PicturePlan:
    """Which pictures are decoded: for each side S, the last so many frames of the history.

    Those of the future are decoded too, at the sides in ``future``.
    """

    history: Mapping[int, int]
    future: frozenset[int]

    @classmethod
    def of(cls, needs: Iterable[PictureNeeds], future: Iterable[int]) -> PicturePlan:
        """What serves all ``needs``, with the future at the sides ``future``."""
        history: dict[int, int] = {}
        for need in needs:
            if need.frames:
                history[need.size] = max(need.frames, history.get(need.size, 0))
        return cls(history, frozenset(future))


class Batch:
    """B sequences; pictures may be those of other sequences.

    Args:
        dataset: where they are.
        indices: (B,) sequences whose landmarks these are.
        plan: what to decode.
        pictures_of: (B,) sequences whose pictures are shown; None: their own.
    """

    def __init__(
        self,
        dataset: FaceDataset,
        indices: Sequence[int],
        plan: PicturePlan,
        pictures_of: Sequence[int] | None = None,
    ) -> None:
        settings = dataset.manifest.settings
        frames = np.stack([dataset.landmarks(index)[..., :2] for index in indices])
        #: (B, T, L, 2) and (B, H, L, 2) float32
        self.history: NDArray[np.float32] = frames[:, : settings.history]
        self.future: NDArray[np.float32] = frames[:, settings.history :]
        self._past: dict[int, NDArray[np.uint8]] = {}
        self._coming: dict[int, NDArray[np.uint8]] = {}
        shown = indices if pictures_of is None else pictures_of
        for size in sorted({*plan.history, *plan.future}):
            past = plan.history.get(size, 0)
            stop = settings.length if size in plan.future else settings.history
            wanted = slice(settings.history - past, stop)
            reduce = reduction(settings.crop_size, size)
            pictures = np.stack([dataset.pictures(index, wanted, reduce) for index in shown])
            self._past[size], self._coming[size] = pictures[:, :past], pictures[:, past:]

    def shown(self, needs: PictureNeeds) -> NDArray[np.uint8] | None:
        """Pictures (B, P, S, S, 3) of the last P frames of the history; None for P = 0."""
        if not needs.frames:
            return None
        past = self._past[needs.size]
        return past[:, past.shape[1] - needs.frames :]

    def last(self, size: int) -> NDArray[np.uint8]:
        """The last picture (B, 1, S, S, 3) of each history."""
        return self._past[size][:, -1:]

    def coming(self, size: int) -> NDArray[np.uint8]:
        """Pictures (B, H, S, S, 3) of the frames to be forecast."""
        return self._coming[size]


#: Pictures are enlarged to at least this side (pixels), the one that the detector's second network
#: looks at: what it does itself with a small picture loses more (the mouth of 64-pixel crops is
#: found within 0.002 of a crop instead of 0.006).
DETECTOR_SIDE = 256


class Detector(Protocol):
    """What is asked of `face_prediction.tracking.detector.FaceDetector`."""

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
