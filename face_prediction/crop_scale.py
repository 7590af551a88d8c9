"""How many metres a crop spans at the mouth, and what share of another camera's image that is."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import open_clip, read_array, read_record
from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation import Camera
from face_prediction.lifting import VERTICAL_FOV_DEGREES


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
