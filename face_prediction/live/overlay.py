"""What is drawn over a live image.

Images are RGB, (rows, columns, 3) uint8. Legend: H horizon, L = 468 landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.crop import Crop
from face_prediction.forecast import mouth_centre
from face_prediction.lifting import LIPS

Colour = tuple[int, int, int]

WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)
#: the mouth now, and the lips
GREEN: Colour = (80, 230, 110)
#: the mouth in the nearest and in the farthest frame that is forecast
NEAR: Colour = (255, 225, 60)
FAR: Colour = (255, 60, 40)
#: Side of the magnified mouth as a share of the image's shorter side.
INSET = 0.34
#: OpenCV's FONT_HERSHEY_SIMPLEX; OpenCV is imported by what draws, so that commands start without
_FONT = 0
#: OpenCV draws at sixteenths of a pixel
_SHIFT = 4


def draw_mouth(
    image: NDArray[np.uint8],
    landmarks: NDArray[np.floating],
    ahead: NDArray[np.floating],
) -> None:
    """Draw the lips and the mouth centre now, and the centres to come, onto ``image``.

    At the lower right the mouth is shown magnified, with the same drawn in: five frames are soon
    over, and a mouth goes a few pixels in them.

    Args:
        image: is drawn on.
        landmarks: (L, 2 or 3) now, normalised image coordinates.
        ahead: (H, L, 2) forecast, in the same.
    """
    import cv2

    size = np.array([image.shape[1], image.shape[0]])
    lips = landmarks[list(LIPS), :2] * size
    path = np.vstack([mouth_centre(landmarks)[None], mouth_centre(ahead)]) * size
    face = float(np.ptp(landmarks[:, 0]) * size[0])
    window = _window(path[0], face)
    side = int(INSET * size.min())
    inset = window.cut(image, side)
    _draw_path(image, lips, path, max(1.5, 0.012 * face))
    scale = side / window.side
    corner = np.array([window.left, window.top])
    _draw_path(inset, (lips - corner) * scale, (path - corner) * scale, max(2.0, 0.012 * side))
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), WHITE, 1)
    image[-side:, -side:] = inset


def draw_lines(image: NDArray[np.uint8], lines: Sequence[tuple[str, Colour]]) -> None:
    """Write lines of text at the top left of ``image``, on a dark ground, sized to it."""
    import cv2

    if not lines:
        return
    scale = max(0.35, min(image.shape[:2]) / 800)
    widest = max(cv2.getTextSize(text, _FONT, scale, 1)[0][0] for text, _ in lines)
    room = image.shape[1] - round(30 * scale)
    if widest > room > 0:
        scale *= room / widest
        widest = room
    step = round(30 * scale)
    ground = image[: step * len(lines) + step // 2, : widest + step]
    ground[:] = (ground * 0.45).astype(np.uint8)
    for number, (text, colour) in enumerate(lines, start=1):
        place = (step // 2, step * number)
        cv2.putText(image, text, place, _FONT, scale, colour, 1, cv2.LINE_AA)


def _window(mouth: NDArray[np.floating], face: float) -> Crop:
    """The square around the mouth that is magnified."""
    side = max(round(0.6 * face), 8)
    left, top = np.round(mouth - side / 2).astype(int)
    return Crop(int(left), int(top), side)


def _draw_path(
    image: NDArray[np.uint8],
    lips: NDArray[np.floating],
    path: NDArray[np.floating],
    radius: float,
) -> None:
    """Dots for the lips (P, 2), the mouth now, and in every later frame (H + 1, 2), in pixels."""
    import cv2

    for point in lips:
        _dot(image, point, radius / 2, GREEN)
    shades = [GREEN, *_shades(len(path) - 1)]
    _dot(image, path[0], radius + 1.5, BLACK)
    for start, end, colour in zip(path[:-1], path[1:], shades[1:], strict=True):
        cv2.line(image, _fixed(start), _fixed(end), colour, 1, cv2.LINE_AA, _SHIFT)
    for point, colour in zip(path, shades, strict=True):
        _dot(image, point, radius, colour)


def _shades(count: int) -> list[Colour]:
    """Colours from `NEAR` to `FAR`."""
    weights = np.linspace(0.0, 1.0, count)[:, None]
    mixed = np.round((1 - weights) * NEAR + weights * FAR).astype(int)
    return [(int(r), int(g), int(b)) for r, g, b in mixed]


def _dot(
    image: NDArray[np.uint8], point: NDArray[np.floating], radius: float, colour: Colour
) -> None:
    import cv2

    size = max(1, round(radius * 2**_SHIFT))
    cv2.circle(image, _fixed(point), size, colour, -1, cv2.LINE_AA, _SHIFT)


def _fixed(point: NDArray[np.floating]) -> tuple[int, int]:
    """OpenCV counts from the middle of the first pixel."""
    x, y = np.round((np.clip(point, -1e4, 1e5) - 0.5) * 2**_SHIFT).astype(int)
    return int(x), int(y)
