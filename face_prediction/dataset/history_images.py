"""The pictures of histories that end in successive frames of a clip, cut out of its video.

Legend: P pictures at the end of a history, S side of the pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.build import SAME_CLOCK
from face_prediction.dataset.clip_file import decode_picture, encode_picture
from face_prediction.dataset.image_batches import reduction
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.prediction.interface import PictureNeeds
from face_prediction.prediction.predicted_motion import Origin
from face_prediction.tracking.crop import Crop
from face_prediction.tracking.tracks import FaceTrack
from face_prediction.tracking.video import VideoReader
from robo_manip_baselines.runs.errors import RequestError


def dataset_picture(
    image: NDArray[np.uint8], crop: Crop, settings: SequenceSettings, size: int
) -> NDArray[np.uint8]:
    """The picture (S, S, 3) of side ``size`` that a dataset would show of ``image`` under ``crop``.

    It goes through JPEG, because that is what predictors have learnt from.

    Raises:
        RequestError: the dataset's pictures cannot be brought to that size.
    """
    reduce = reduction(settings.crop_size, size)
    whole = crop.cut(image, settings.crop_size)
    return decode_picture(encode_picture(whole, settings.quality), reduce)


@dataclass
class _Window:
    """The last decoded images, and what has been cut out of them at the present crop."""

    settings: SequenceSettings
    size: int
    images: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    crop: Crop | None = None
    cut: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    def picture(self, number: int, crop: Crop) -> NDArray[np.uint8]:
        """The picture (S, S, 3) of a decoded image."""
        if crop != self.crop:
            self.crop, self.cut = crop, {}
        if number not in self.cut:
            self.cut[number] = dataset_picture(self.images[number], crop, self.settings, self.size)
        return self.cut[number]

    def forget(self, before: int) -> None:
        """Drop images that no later history needs."""
        for kept in (self.images, self.cut):
            for number in [n for n in kept if n < before]:
                del kept[number]


def history_pictures(
    path: Path,
    track: FaceTrack,
    source_frame: NDArray[np.integer],
    origins: Sequence[Origin],
    needs: PictureNeeds,
    settings: SequenceSettings,
) -> Iterator[NDArray[np.uint8]]:
    """The pictures (P, S, S, 3) of each of ``origins``, whose frames must increase.

    Args:
        path: the video.
        track: of the same video.
        source_frame: (T of the clip,) the decoded image that stands for each frame.
        origins: what is forecast from.
        needs: how many pictures, and of what size.
        settings: of the dataset.

    Raises:
        RequestError: the video breaks off, or is not the one of the track; or a dataset with these
            settings has no pictures of that size.
    """
    window = _Window(settings, needs.size)
    waiting = [source_frame[origin.history[-needs.frames :]] for origin in origins]
    if not waiting:
        return
    times = track.source_timestamps
    done = 0
    with VideoReader(path) as video:
        for number, frame in enumerate(video.frames()):
            if number >= len(times) or abs(frame.time - times[number]) > SAME_CLOCK:
                raise RequestError(
                    f"{path}: its frame {number} at {frame.time:.4f} s is not in its track; "
                    "extract the track again"
                )
            if number >= waiting[done][0]:
                window.images[number] = frame.image
            while done < len(waiting) and waiting[done][-1] <= number:
                crop = origins[done].crop
                yield np.stack([window.picture(n, crop) for n in waiting[done].tolist()])
                done += 1
                if done == len(waiting):
                    return
                window.forget(int(waiting[done][0]))
    raise RequestError(f"{path}: has fewer frames than its track; extract the track again")
