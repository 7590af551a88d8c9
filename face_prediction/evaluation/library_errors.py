"""How many metres a crop spans at the mouth, and what share of another camera's image that is."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import open_clip, read_array, read_record
from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation import Camera, ErrorStats
from face_prediction.evaluation.error_stats import ResidualRun
from face_prediction.motion.library import RecordedMotion
from face_prediction.tracking.geometry import VERTICAL_FOV_DEGREES
from robo_manip_baselines.runs.errors import RequestError


def crop_spans(dataset: FaceDataset, clips: Iterable[str]) -> NDArray[np.float64]:
    """Metres (N,) that the crop of every sequence of ``clips`` spans, across the view.

    A crop of s pixels, seen with a focal length of f pixels (that of `lifting`, from its vertical
    field of view), spans s / f times the distance of the mouth in the last frame of the history.

    Raises:
        RequestError: a clip's file is damaged.
    """
    spans: list[NDArray[np.float64]] = []
    last = dataset.manifest.settings.history - 1
    for clip in clips:
        path = dataset.folder / CLIP_FOLDER / f"{clip}.h5"
        with open_clip(path) as file:
            height = read_record(path, file)["image_size"][1]
            side = read_array(path, file, "sequences/crop")[:, 2]
            start = read_array(path, file, "sequences/start")
            mouth = read_array(path, file, "frames/mouth")
        focal = height / 2 / math.tan(math.radians(VERTICAL_FOV_DEGREES / 2))
        spans.append(side / focal * -mouth[start + last, 2])
    return np.concatenate(spans)


def camera_with_crop(
    camera: Camera, span: float, width: float | None = None, height: float | None = None
) -> Camera:
    """``camera`` with a crop of ``span`` metres at its depth, as shares of its image.

    ``width`` and ``height``, where given, are those shares instead.
    """
    whole = replace(camera, crop_width=1.0, crop_height=1.0)
    across, up = whole.metres(np.ones(2))
    return replace(
        camera,
        crop_width=span / float(across) if width is None else width,
        crop_height=span / float(up) if height is None else height,
    )


@dataclass(frozen=True)
class LibraryResiduals:
    """Signed errors of N forecasts, and where each is from."""

    #: (N, H, 2) m across the view: to the right, and down as V is
    metres: NDArray[np.float64]
    clips: tuple[str, ...]
    subjects: tuple[str, ...]
    #: frames counted through each clip's runs, one apart within a run and further between runs
    starts: tuple[int, ...]


def library_residuals(library: RecordedMotion, clips: Collection[str]) -> LibraryResiduals:
    """Errors of every forecast in the runs of ``clips`` whose H frames the run holds.

    Raises:
        RequestError: the library holds no forecasts, or none of these clips.
    """
    if library.predicted_mouth is None:
        raise RequestError("--library: holds no forecasts; make it with face-prediction predict")
    parts: list[NDArray[np.float64]] = []
    names: list[str] = []
    people: list[str] = []
    starts: list[int] = []
    horizon = library.predicted_mouth.shape[1]
    for index, name in enumerate(library.run_clip.tolist()):
        part = library.run(index)
        count = part.stop - part.start - horizon
        if name not in clips or count < 1:
            continue
        mouth = library.mouth[part].astype(np.float64)
        ahead = library.predicted_mouth[part].astype(np.float64)
        came = np.stack([mouth[h : h + count] for h in range(1, horizon + 1)], axis=1)
        apart = ahead[:count] - came
        parts.append(apart[..., :2] * (1.0, -1.0))  # y is up, V is down
        names += [name] * count
        people += [str(library.run_subject[index])] * count
        starts += range(part.start, part.start + count)
    if not parts:
        raise RequestError(f"--library: has no run of the clips {', '.join(sorted(clips))}")
    return LibraryResiduals(np.concatenate(parts), tuple(names), tuple(people), tuple(starts))


def shortened(stats: ErrorStats, frames: int) -> ErrorStats:
    """``stats`` with at most so many forecasts of each clip kept as runs, its longest runs first.

    A file that holds every forecast of minutes is large, and no more is needed to draw from.
    """
    room: dict[str, int] = {}
    kept: list[ResidualRun] = []
    for run in sorted(stats.residuals, key=lambda run: -len(run.values)):
        count = min(len(run.values), frames - room.get(run.clip, 0))
        if count < 1:
            continue
        room[run.clip] = room.get(run.clip, 0) + count
        kept.append(replace(run, values=run.values[:count]))
    return replace(stats, residuals=tuple(kept))
