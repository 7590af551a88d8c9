"""What moves in each sequence: one row of numbers for each.

Legend: N sequences, F frames of one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from face_prediction.dataset.crop import Crop
from face_prediction.dataset.sequences import ClipFrames, Sequences
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.lifting import LIPS


@dataclass(frozen=True)
class Fact:
    """A column of the table of sequences."""

    name: str
    unit: str
    description: str


FACTS: tuple[Fact, ...] = (
    Fact("start_time", "s", "Time of the first frame on the video's clock"),
    Fact("mouth_range_u", "crop", "Largest less smallest u of the mouth centre"),
    Fact("mouth_range_v", "crop", "Largest less smallest v of the mouth centre"),
    Fact("mouth_range_x", "m", "The same of its lifted position, x"),
    Fact("mouth_range_y", "m", "... y"),
    Fact("mouth_range_z", "m", "... z (away from the camera; the least certain)"),
    Fact("head_rotation_range", "deg", "Largest angle between the head's orientations in any two"),
    Fact("mouth_opening_range", "m", "Largest less smallest distance between the inner lips"),
    Fact("interpolated_share", "1", "Share of frames made from two decoded ones"),
    Fact("image_lag", "s", "Longest time between a frame and the picture that stands for it"),
    Fact("crop_side", "px", "Side of the crop in the video"),
    Fact("crop_padding", "1", "Share of the crop outside the video's picture (black)"),
    Fact("outside_share", "1", "Share of the frames to predict in which the face leaves the crop"),
)


def sequence_facts(
    frames: ClipFrames, sequences: Sequences, settings: SequenceSettings
) -> dict[str, np.ndarray]:
    """The columns of `FACTS`, each (N,) float64."""
    rows = [
        _facts_of(frames, int(start), crop, settings)
        for start, crop in zip(sequences.start, sequences.crops, strict=True)
    ]
    return {
        fact.name: np.array([row[fact.name] for row in rows], dtype=np.float64) for fact in FACTS
    }


def largest_angle(orientation: np.ndarray) -> float:
    """Largest angle in degrees between any two of the unit quaternions (F, 4)."""
    cosine = np.abs(orientation @ orientation.T).min()
    return float(np.degrees(2 * np.arccos(np.clip(cosine, 0.0, 1.0))))


def _facts_of(
    frames: ClipFrames, start: int, crop: Crop, settings: SequenceSettings
) -> dict[str, float]:
    part = slice(start, start + settings.length)
    points = crop.normalise(frames.landmarks[part], frames.image_size)[..., :2]  # (F, 468, 2)
    centre = points[:, list(LIPS)].mean(axis=1)
    u, v = np.ptp(centre, axis=0)
    x, y, z = np.ptp(frames.mouth[part], axis=0)
    future = points[settings.history :]
    outside = np.any((future < 0.0) | (future > 1.0), axis=(1, 2))
    return {
        "start_time": float(frames.timestamps[start]),
        "mouth_range_u": float(u),
        "mouth_range_v": float(v),
        "mouth_range_x": float(x),
        "mouth_range_y": float(y),
        "mouth_range_z": float(z),
        "head_rotation_range": largest_angle(frames.orientation[part]),
        "mouth_opening_range": float(np.ptp(frames.jaw[part])),
        "interpolated_share": float(frames.interpolated[part].mean()),
        "image_lag": float(np.abs(frames.image_lag[part]).max()),
        "crop_side": float(crop.side),
        "crop_padding": crop.padding(frames.image_size),
        "outside_share": float(outside.mean()),
    }
