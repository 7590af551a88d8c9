"""What a predictor would have told the robot, frame by frame of a recorded motion.

Every frame is forecast from the frames of its clip up to it, seen through a crop that is laid
around them, as in a dataset. Metres: the mouth is taken to move parallel to the image, at the
depth that it has in the frame.

Legend: N frames that are forecast, T frames of history, H horizon, L = 468 landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast import mouth_centre
from face_prediction.motion.motion import Quality
from face_prediction.tracking.crop import Crop, crop_around
from face_prediction.tracking.lifting import image_rays


@dataclass(frozen=True)
class Origin:
    """A frame that is forecast from, and what is seen until then."""

    #: of the clip
    frame: int
    #: (T,) frames of the history; before the first usable one stands that one again
    history: NDArray[np.int64]
    crop: Crop

    @property
    def is_short(self) -> bool:
        """Whether the clip holds fewer usable frames than a whole history."""
        return len(self.history) > 1 and bool(self.history[0] == self.history[1])


def find_origins(
    frames: Sequence[int],
    landmarks: NDArray[np.floating],
    image_size: tuple[int, int],
    quality: Quality,
    length: int,
    margin: float,
) -> list[Origin]:
    """The histories of ``length`` frames that end in each of ``frames``.

    A history does not reach back across a lost face, a spike or a jump of the detector; where
    that leaves less, the face is taken to have been at rest before.

    Args:
        frames: of the clip, each in a stretch without any of those.
        landmarks: (T of the clip, L, 2 or 3) normalised image coordinates.
        image_size: (width, height) in pixels.
        quality: of the clip's frames.
        length: frames of a history.
        margin: of the crop, see `crop_around`.
    """
    begins = np.zeros(len(landmarks), dtype=np.int64)
    for start, stop in quality.segments():
        begins[start:stop] = start
    origins: list[Origin] = []
    for frame in frames:
        rows = np.maximum(np.arange(frame - length + 1, frame + 1), begins[frame])
        seen = landmarks[rows[0] : frame + 1]
        origins.append(Origin(frame, rows, crop_around(seen, image_size, margin)))
    return origins


def crop_history(
    origin: Origin, landmarks: NDArray[np.floating], image_size: tuple[int, int]
) -> NDArray[np.float32]:
    """The landmarks (T, L, 2) of a history in its crop."""
    points = origin.crop.normalise(landmarks[origin.history], image_size)
    return points[..., :2].astype(np.float32)


def image_points(
    crop: Crop, points: NDArray[np.floating], image_size: tuple[int, int]
) -> NDArray[np.float64]:
    """Crop coordinates (..., 2) as normalised image coordinates (..., 2)."""
    corner = np.array([crop.left, crop.top], dtype=np.float64)
    return (np.asarray(points, dtype=np.float64) * crop.side + corner) / image_size


def mouth_ahead(
    mouth: NDArray[np.floating],
    now: NDArray[np.floating],
    ahead: NDArray[np.floating],
    image_size: tuple[int, int],
) -> NDArray[np.float64]:
    """Mouth positions (N, H, 3) in metres, from where the mouth centre is forecast in the image.

    Args:
        mouth: (N, 3) m where the mouth is; camera frame.
        now: (N, 2) its centre, normalised image coordinates.
        ahead: (N, H, 2) the centre as it is forecast.
        image_size: (width, height) in pixels.
    """
    moved = image_rays(ahead, image_size) - image_rays(now, image_size)[:, None]
    here = np.asarray(mouth, dtype=np.float64)[:, None]
    return here - moved * here[..., 2:]  # rays have z = -1, so that z stays as it is


def forecast_metres(
    origins: Sequence[Origin],
    forecasts: NDArray[np.floating],
    landmarks: NDArray[np.floating],
    mouth: NDArray[np.floating],
    image_size: tuple[int, int],
) -> NDArray[np.float64]:
    """Mouth positions (N, H, 3) in metres of forecasts (N, H, L, 2) in crops.

    Args:
        origins: N of them.
        forecasts: one for each.
        landmarks: (T of the clip, L, 2 or 3) normalised image coordinates.
        mouth: (T of the clip, 3) m.
        image_size: (width, height) in pixels.
    """
    frames = [origin.frame for origin in origins]
    centres = mouth_centre(forecasts)
    ahead = [image_points(o.crop, c, image_size) for o, c in zip(origins, centres, strict=True)]
    return mouth_ahead(mouth[frames], mouth_centre(landmarks[frames]), np.stack(ahead), image_size)


def errors_across(
    predicted: NDArray[np.floating], mouth: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Distances (N, H) in metres across the view between a run's forecasts and what came.

    NaN where the run has ended by then.

    Args:
        predicted: (N, H, 3) m of the successive frames of one run.
        mouth: (N, 3) m.
    """
    count, horizon = predicted.shape[:2]
    errors = np.full((count, horizon), np.nan)
    for h in range(1, horizon + 1):
        apart = predicted[: max(count - h, 0), h - 1, :2] - mouth[h:, :2]
        errors[: len(apart), h - 1] = np.linalg.norm(apart, axis=1)
    return errors
