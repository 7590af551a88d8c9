"""A square window that stands still for a whole sequence, as a fixed camera's picture does.

Coordinates: pixels of the displayed image, x right and y down, 0 at the outer edge of the first
pixel; in a crop, the same divided by its side, so that the picture spans 0...1.

Legend: T frames, L landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Crop:
    """A square of the image: left and top edge and side, whole pixels.

    It may reach beyond the image.
    """

    left: int
    top: int
    side: int

    def normalise(self, landmarks: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
        """Crop coordinates (..., 3) of ``landmarks`` (..., 3), normalised image coordinates.

        Depth, given in image widths, becomes crop sides.
        """
        scale = np.array([image_size[0], image_size[1], image_size[0]], dtype=np.float64)
        offset = np.array([self.left, self.top, 0.0])
        return (np.asarray(landmarks, dtype=np.float64) * scale - offset) / self.side

    def cut(self, image: np.ndarray, size: int) -> np.ndarray:
        """The part of ``image`` (H, W, 3) under the crop as (size, size, 3), black outside it."""
        import cv2  # not needed to make or read anything but pictures

        height, width = image.shape[:2]
        rows = np.clip([self.top, self.top + self.side], 0, height)
        columns = np.clip([self.left, self.left + self.side], 0, width)
        part = image[rows[0] : rows[1], columns[0] : columns[1]]
        if part.shape[:2] != (self.side, self.side):
            whole = np.zeros((self.side, self.side, 3), dtype=np.uint8)
            top, left = rows[0] - self.top, columns[0] - self.left
            whole[top : top + part.shape[0], left : left + part.shape[1]] = part
            part = whole
        # areas average when shrinking, which leaves no false patterns; lines join when enlarging
        method = cv2.INTER_AREA if self.side > size else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(part, (size, size), interpolation=method), dtype=np.uint8)

    def padding(self, image_size: tuple[int, int]) -> float:
        """Share of the crop's area that lies outside the image, 0...1."""
        width = min(self.left + self.side, image_size[0]) - max(self.left, 0)
        height = min(self.top + self.side, image_size[1]) - max(self.top, 0)
        return 1.0 - max(width, 0) * max(height, 0) / self.side**2


def crop_around(landmarks: np.ndarray, image_size: tuple[int, int], margin: float) -> Crop:
    """The crop around all faces of a stretch of frames.

    Its side is (1 + 2 margin) times the longer side of the box around every landmark of every
    frame, and its middle that of the box. Where the image is large enough it is moved inside.

    Args:
        landmarks: (T, L, 2 or 3) normalised image coordinates, all finite.
        image_size: (width, height) in pixels.
        margin: room on each side, in lengths of the box's longer side.
    """
    size = np.array(image_size, dtype=np.float64)
    points = np.asarray(landmarks, dtype=np.float64)[..., :2].reshape(-1, 2) * size
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(int(np.ceil((high - low).max() * (1 + 2 * margin))), 1)
    corner = np.round((low + high) / 2 - side / 2).astype(int)
    room = np.array(image_size) - side
    corner = np.where(room >= 0, np.clip(corner, 0, np.maximum(room, 0)), corner)
    return Crop(int(corner[0]), int(corner[1]), side)
