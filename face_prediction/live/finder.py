"""The detector as `extract` uses it: one person is followed, small faces are looked at closely."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from face_prediction.detector import DetectorSettings, FaceDetector
from face_prediction.extract import FaceFollower
from face_prediction.face_geometry import read_canonical_face
from face_prediction.zoom import ZoomingDetector


class FaceFinder:
    """Finds the same face in successive images. Use as a context manager.

    Args:
        model: MediaPipe's face_landmarker.task.

    Raises:
        RequestError: MediaPipe is not installed, or the model cannot be loaded.
    """

    def __init__(self, model: Path) -> None:
        self._detector = FaceDetector(model, DetectorSettings())
        self._zooming = ZoomingDetector(self._detector.detect, read_canonical_face(model))
        self._follower = FaceFollower()

    def __enter__(self) -> FaceFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._detector.close()

    def find(self, image: NDArray[np.uint8], time: float) -> NDArray[np.float64] | None:
        """Landmarks (468, 3), normalised image coordinates, or None.

        Args:
            image: (rows, columns, 3) uint8 RGB.
            time: s, later than the one before.
        """
        size = (image.shape[1], image.shape[0])
        faces = self._zooming.detect(image, time)
        face = self._follower.choose(faces, time, size)
        return None if face is None else self._zooming.refine(face, image, time).landmarks
