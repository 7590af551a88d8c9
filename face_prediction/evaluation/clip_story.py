"""What a clip's video shows: where the mouth went, and where it was forecast to go.

Legend: W successive sequences of a clip, H horizon, T frames shown; the last axis holds U and V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import open_clip, read_array
from face_prediction.dataset.crop import Crop
from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.contestants import PERSISTENCE
from face_prediction.evaluation.judge import Verdict
from face_prediction.evaluation.mouth_errors import mouth_distances
from face_prediction.evaluation.residuals import neighbours
from face_prediction.forecast.mouth import mouth_centre

Floats = NDArray[np.float64]

#: Frames before the first forecast, so that it does not come at once.
LEAD = 20
#: Seconds of a clip that are shown, at most.
LONGEST = 6.0


@dataclass(frozen=True)
class ClipStory:
    """What is shown; places are pixels of the clip's own images."""

    clip: str
    #: (T,) frame numbers in the clip, its rate, and the true mouth centre (T, 2) in each
    frames: NDArray[np.int64]
    fps: float
    mouth: Floats
    #: T pictures (S, S, 3), and where each lies in the image
    pictures: Sequence[NDArray[np.uint8]]
    crops: Sequence[Crop]
    #: name and forecasts (W, H, 2) of the mouth centre of each predictor shown
    forecasts: Sequence[tuple[str, Floats]]
    #: (W,) frame numbers of the last frames of the histories
    origins: NDArray[np.int64]

    @property
    def is_dense(self) -> bool:
        """Whether a new forecast comes before the last one has been caught up with."""
        horizon = self.forecasts[0][1].shape[1]
        return len(self.origins) > 1 and bool(np.diff(self.origins).min() < horizon)

    def seconds(self, frames: NDArray[np.integer]) -> Floats:
        """Times of frame numbers in the clip."""
        return frames / self.fps


def clip_story(
    dataset: FaceDataset,
    indices: Sequence[int],
    residuals: Sequence[tuple[str, Floats]],
) -> ClipStory:
    """The story of sequences ``indices`` that follow one another in a clip.

    Args:
        dataset: where they are.
        indices: W of them, each beginning the stride after the one before it.
        residuals: name and errors (W, H, 2) in crops of each predictor to be shown.
    """
    settings = dataset.manifest.settings
    clip = dataset.entry(indices[0]).clip
    path = dataset.folder / CLIP_FOLDER / f"{clip}.h5"
    with open_clip(path) as file:
        corners = read_array(path, file, "sequences/crop")
        starts = read_array(path, file, "sequences/start")
    first = next(i for i in range(len(dataset)) if dataset.entry(i).clip == clip)
    frames: list[int] = []
    mouth: list[Floats] = []
    pictures: list[NDArray[np.uint8]] = []
    crops: list[Crop] = []
    forecasts = [(name, np.empty_like(errors)) for name, errors in residuals]
    origins: list[int] = []
    for place, index in enumerate(indices):
        crop = Crop(*map(int, corners[index - first]))
        start = int(starts[index - first])
        low = np.array([crop.left, crop.top])
        path_here = low + crop.side * mouth_centre(dataset.landmarks(index))
        for (_, errors), (_, forecast) in zip(residuals, forecasts, strict=True):
            forecast[place] = path_here[settings.history :] + crop.side * errors[place]
        origins.append(start + settings.history - 1)
        # each sequence adds what is new in its history, the last one also what was to be forecast
        shown_from = settings.history - (settings.stride if place else LEAD)
        shown_to = settings.length if place == len(indices) - 1 else settings.history
        part = slice(max(shown_from, 0), shown_to)
        frames += range(start + part.start, start + part.stop)
        mouth += list(path_here[part])
        pictures += list(dataset.pictures(index, part))
        crops += [crop] * (part.stop - part.start)
    return ClipStory(
        clip=clip,
        frames=np.array(frames),
        fps=settings.fps,
        mouth=np.stack(mouth),
        pictures=pictures,
        crops=crops,
        forecasts=forecasts,
        origins=np.array(origins),
    )


def telling_run(verdict: Verdict, kind: str, stride: int, fps: float) -> NDArray[np.intp]:
    """Places of successive sequences of one clip of a kind, `LONGEST` in all at most.

    Of the longest that there are, the one whose mouth moves more than three quarters of the others'
    do, by the error of persistence: with too little motion there is nothing to see.
    """
    selection = verdict.selection
    places = selection.of_kind(kind)
    clips = [selection.clips[place] for place in places]
    runs = neighbours(clips, selection.starts[places].tolist(), stride)
    count = max(1, int(LONGEST * fps) // stride)
    parts = [run[i : i + count] for run in runs for i in range(0, len(run), count)]
    longest = max(map(len, parts))
    candidates = [places[part] for part in parts if len(part) == longest]
    size = mouth_distances(verdict.row(PERSISTENCE).residuals)
    order = sorted(candidates, key=lambda part: float(size[part].mean()))
    return order[int(0.75 * (len(order) - 1))]
