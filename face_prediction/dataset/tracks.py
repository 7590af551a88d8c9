"""Whole tracks of a dataset: every stretch of a clip that a face can be watched through.

A sequence shows 75 frames of a face; a track is all there is. Landmarks are in image pixels, so
that one frame's unit is the next one's, and the crop that errors are measured in is laid around the
last frames before each, as a sequence's is.

Legend: T frames of a track, L = 468 landmarks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import open_clip, read_array, read_record
from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.motion.motion import Quality, assess
from face_prediction.tracking.tracks import Size


@dataclass(frozen=True)
class FaceStretch:
    """Frames of a clip without a lost face, a spike or a jump among them.

    Attributes:
        clip: its clip.
        subject: the person.
        kind: of footage.
        fold: the person's.
        start: first frame, in the clip at the dataset's rate.
        landmarks: (T, L, 2) float32 pixels, u right and v down.
    """

    clip: str
    subject: str
    kind: str
    fold: int
    start: int
    landmarks: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.landmarks)

    def crop_sides(self, settings: SequenceSettings) -> NDArray[np.float64]:
        """Side (T,) in pixels of the crop around the last frames up to each, the history's."""
        low, high = self.landmarks.min(axis=1), self.landmarks.max(axis=1)
        sides = np.empty(len(self))
        for frame in range(len(self)):
            seen = slice(max(0, frame - settings.history + 1), frame + 1)
            sides[frame] = (high[seen].max(axis=0) - low[seen].min(axis=0)).max()
        return sides * (1 + 2 * settings.margin)


def without_windows(
    stretches: Iterable[FaceStretch], windows: Mapping[str, Iterable[tuple[int, int]]]
) -> list[FaceStretch]:
    """Remainder of stretches without the frames of ``windows`` (first frame, end), by clip."""
    found: list[FaceStretch] = []
    for stretch in stretches:
        stop = stretch.start + len(stretch)
        begin = stretch.start
        for first, end in [*sorted(windows.get(stretch.clip, ())), (stop, stop)]:
            until = min(first, stop)
            if until > begin:
                frames = slice(begin - stretch.start, until - stretch.start)
                found.append(replace(stretch, start=begin, landmarks=stretch.landmarks[frames]))
            begin = max(begin, end)
    return found


def pixel_landmarks(landmarks: NDArray[np.floating], image_size: Size) -> NDArray[np.float32]:
    """Landmarks (T, L, 2) in pixels of normalised image coordinates (T, L, 2 or 3)."""
    return (landmarks[..., :2] * np.array(image_size, dtype=np.float64)).astype(np.float32)


def dataset_stretches(
    dataset: FaceDataset, folds: Collection[int] | None = None, least: int | None = None
) -> list[FaceStretch]:
    """The stretches of ``least`` frames or more, by default of a sequence, of people in ``folds``.

    Raises:
        RequestError: a clip's file is damaged.
    """
    settings = dataset.manifest.settings
    least = settings.length if least is None else least
    found: list[FaceStretch] = []
    for entry in dataset.manifest.clips:
        if entry.fold is None or (folds is not None and entry.fold not in folds):
            continue
        path = dataset.folder / CLIP_FOLDER / f"{entry.clip}.h5"
        with open_clip(path) as file:
            image_size = tuple(read_record(path, file)["image_size"])
            mouth, orientation, jaw, landmarks = (
                read_array(path, file, f"frames/{name}")
                for name in ("mouth", "orientation", "jaw", "landmarks")
            )
        quality: Quality = assess(mouth, orientation, jaw, settings.fps, settings.limits)
        for start, stop in quality.segments():
            if stop - start >= least:
                found.append(
                    FaceStretch(
                        clip=entry.clip,
                        subject=entry.subject,
                        kind=entry.kind,
                        fold=entry.fold,
                        start=start,
                        landmarks=pixel_landmarks(landmarks[start:stop], image_size),
                    )
                )
    return found
