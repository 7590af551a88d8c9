"""Histories that end in given frames of a recorded clip, and forecasts from them in metres.

Every frame is forecast from the frames of its clip up to it, seen through a crop around these, as
in a dataset. Metres: the mouth is taken to move parallel to the image, at its depth in the frame.

Legend: N frames that are forecast from, T frames of history, H horizon, L = 468 landmarks, P images
at the end of a history, S their side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.build import track_frames
from face_prediction.dataset.clip_file import reduction
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.forecast.interface import Array, mouth_centre
from face_prediction.motion.motion import Quality
from face_prediction.prediction.interface import ImageNeeds
from face_prediction.tracking.geometry import Crop, crop_around, image_points, image_rays
from face_prediction.tracking.tracks import FaceTrack, Size
from robo_manip_baselines.runs.images import decode_image, encode_image


@dataclass(frozen=True)
class Origin:
    """A frame that is forecast from, and its history.

    Attributes:
        frame: of the clip.
        history: (T,) frames of the history; the first usable one is repeated before it.
        crop: around the faces of the history.
    """

    frame: int
    history: NDArray[np.int64]
    crop: Crop

    @property
    def is_short(self) -> bool:
        """The clip holds fewer usable frames than a whole history."""
        return len(self.history) > 1 and bool(self.history[0] == self.history[1])


def find_origins(
    frames: Sequence[int],
    landmarks: Array,
    image_size: Size,
    quality: Quality,
    length: int,
    margin: float,
) -> list[Origin]:
    """The histories of ``length`` frames that end in each of ``frames``.

    A history does not reach back across a lost face, a spike or a jump of the detector; where
    that leaves less, the face is taken to have been at rest before.
    ``frames`` are each in a stretch without any of those; ``landmarks`` (T of the clip, L, 2 or 3)
    are normalised image coordinates, and ``margin`` is that of `crop_around`.
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


def crop_history(origin: Origin, landmarks: Array, image_size: Size) -> NDArray[np.float32]:
    """The landmarks (T, L, 2) of a history in its crop."""
    points = origin.crop.normalise(landmarks[origin.history], image_size)
    return points[..., :2].astype(np.float32)


def dataset_image(
    image: NDArray[np.uint8], crop: Crop, settings: SequenceSettings, size: int
) -> NDArray[np.uint8]:
    """The image (S, S, 3) of side ``size`` that a dataset holds of ``image`` under ``crop``.

    It goes through JPEG, because predictors have learnt from such images.

    Raises:
        RequestError: the dataset's images cannot be brought to that size.
    """
    reduce = reduction(settings.crop_size, size)
    whole = crop.cut(image, settings.crop_size)
    return decode_image(encode_image(whole, quality=settings.quality), reduce)


def history_images(
    path: Path,
    track: FaceTrack,
    source_frame: NDArray[np.integer],
    origins: Sequence[Origin],
    needs: ImageNeeds,
    settings: SequenceSettings,
) -> Iterator[NDArray[np.uint8]]:
    """The images (P, S, S, 3) of each of ``origins``, whose frames must increase.

    They are cut out of the video at ``path``, that of ``track``; ``source_frame`` (T of the clip,)
    is the decoded frame nearest to each frame.

    Raises:
        RequestError: the video breaks off, or is not the one of the track; or a dataset with these
            settings has no images of that size.
    """
    waiting = [source_frame[o.history[-needs.frames :]].tolist() for o in origins][::-1]
    crops = [origin.crop for origin in origins][::-1]
    decoded: dict[int, NDArray[np.uint8]] = {}
    cut: dict[tuple[int, Crop], NDArray[np.uint8]] = {}
    if not waiting:
        return
    for number, image in track_frames(path, track):
        if number >= waiting[-1][0]:
            decoded[number] = image
        while waiting and waiting[-1][-1] <= number:
            wanted, crop = waiting.pop(), crops.pop()
            for n in wanted:
                if (n, crop) not in cut:
                    cut[n, crop] = dataset_image(decoded[n], crop, settings, needs.size)
            yield np.stack([cut[n, crop] for n in wanted])
            if not waiting:
                return
            # only what later histories need is kept
            first, crop = waiting[-1][0], crops[-1]
            decoded = {n: kept for n, kept in decoded.items() if n >= first}
            cut = {(n, c): kept for (n, c), kept in cut.items() if n >= first and c == crop}


def mouth_ahead(mouth: Array, now: Array, ahead: Array, image_size: Size) -> NDArray[np.float64]:
    """Mouth positions (N, H, 3) in metres from forecasts of the mouth centre in the image.

    ``mouth`` (N, 3) m is the present position in the camera frame; ``now`` (N, 2) is the present
    centre and ``ahead`` (N, H, 2) the forecast ones, in normalised image coordinates.
    """
    moved = image_rays(ahead, image_size) - image_rays(now, image_size)[:, None]
    here = np.asarray(mouth, dtype=np.float64)[:, None]
    return here - moved * here[..., 2:]  # rays have z = -1, so that z stays as it is


def forecast_metres(
    origins: Sequence[Origin], forecasts: Array, landmarks: Array, mouth: Array, image_size: Size
) -> NDArray[np.float64]:
    """Mouth positions (N, H, 3) in metres of forecasts (N, H, L, 2) in the crops of N origins.

    Of the whole clip: ``landmarks`` (T, L, 2 or 3), normalised image coordinates, and ``mouth``
    (T, 3) m.
    """
    frames = [origin.frame for origin in origins]
    pairs = zip(origins, mouth_centre(forecasts), strict=True)
    ahead = [image_points(origin.crop, centre, image_size) for origin, centre in pairs]
    return mouth_ahead(mouth[frames], mouth_centre(landmarks[frames]), np.stack(ahead), image_size)


def errors_across(predicted: Array, mouth: Array) -> NDArray[np.float64]:
    """Errors (N, H) in metres across the view of a run's forecasts.

    ``predicted`` (N, H, 3) m and ``mouth`` (N, 3) m are of the successive frames of one run; NaN
    where it has ended by then.
    """
    count, horizon = predicted.shape[:2]
    errors = np.full((count, horizon), np.nan)
    for h in range(1, horizon + 1):
        apart = predicted[: max(count - h, 0), h - 1, :2] - mouth[h:, :2]
        errors[: len(apart), h - 1] = np.linalg.norm(apart, axis=1)
    return errors
