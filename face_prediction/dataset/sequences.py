"""Sequences of a clip: settings, frames at a constant rate, cutting, and statistics.

Legend: T frames, S decoded frames, N sequences, F frames of one, L = 468 landmarks.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from annotated_types import Interval
from numpy.typing import NDArray

from face_prediction.motion.attribution import Attribution
from face_prediction.motion.motion import Quality, QualityLimits, assess
from face_prediction.tracking.extract import SAME_TIME, Samples, resample
from face_prediction.tracking.geometry import LIPS, Crop, crop_around, lift_landmarks
from face_prediction.tracking.tracks import FaceTrack, Size
from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Quality as JpegQuality
from robo_manip_baselines.runs.ranges import require_ranges

CropFrom = Literal["history", "sequence"]

REASONS: tuple[str, ...] = ("no_face", "jump", "spike")
"""Reasons for dropping a sequence; the first that holds is counted."""

KINDS = ("natural", "head_motion", "grid")
"""Kinds of footage. natural: people who talk or look about, mixed. head_motion: clear or deliberate
motion of the head. grid: the GRID corpus, sentences read with hardly any motion of the head."""
HEAD_MOTION_WORDS = ("nod", "nodding", "turn", "turning", "tilt", "tilting", "large motion")
"""Words of a table's column `what` that mean head_motion."""


HEAD_MOTION_DEGREES = 20.0
"""Median over a clip's sequences of the largest angle between two orientations of the head, from
which a clip that nobody has described counts as head_motion. Of the development clips described
with those words it is 2 to 28 degrees, of the other 31 natural ones 20 or more in four."""


@dataclass(frozen=True)
class SequenceSettings:
    """Settings of cutting clips into sequences; recorded with them.

    Attributes:
        history: Frames that a predictor gets (paper, IV.B).
        future: Frames that it predicts (paper, IV.B).
        fps: Frames per second of the sequences (paper, IV.B).
        stride: Frames between the starts of neighbouring sequences.
        margin: Room on each side of the face, in lengths of the longer side of the box around it.
        crop_from: Frames that the crop is laid around. With sequence the face never leaves it, but
            the place of the crop reveals the future motion (docs/face_dataset.md).
        crop_size: Side of the images in pixels (paper, IV.A).
        quality: Quality of the JPEG images, 1 to 100.
        limits: Limits of human motion; anything beyond is a jump of the detector. No option.

    Raises:
        RequestError: a value is out of its range; the message names the option.
    """

    history: Annotated[int, Interval(ge=1, le=10_000)] = 70
    future: Annotated[int, Interval(ge=1, le=10_000)] = 5
    fps: Annotated[float, Interval(gt=0.0, le=1000.0)] = 30.0
    stride: Annotated[int, Interval(ge=1, le=1_000_000)] = 15
    margin: Annotated[float, Interval(ge=0.0, le=2.0)] = 0.1
    crop_from: CropFrom = "history"
    crop_size: Annotated[int, Interval(ge=16, le=4096)] = 256
    quality: JpegQuality = 90
    limits: tyro.conf.Suppress[QualityLimits] = field(default_factory=QualityLimits)

    def __post_init__(self) -> None:
        require_ranges(self, "--{} {}")

    @property
    def length(self) -> int:
        """Frames of a sequence."""
        return self.history + self.future

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and text, what `from_json` takes."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> SequenceSettings:
        """Undo `to_json`.

        Raises:
            RequestError: ``data`` holds other keys or values that are no settings.
        """
        return convert(data, cls, "settings", complete=True)


def kind_of(row: Attribution, rotations: Sequence[float] = ()) -> str:
    """Kind of a clip by its row in the table of attributions, or by its motion.

    ``kind`` counts as it stands; then a name that begins with ``grid`` is grid; then the words of
    `HEAD_MOTION_WORDS` in ``what`` decide. Without ``what``, the median of ``rotations`` does: of
    each sequence the largest angle between two orientations of the head, in degrees.

    Raises:
        RequestError: ``kind`` is none of `KINDS`.
    """
    if row.kind in KINDS:
        return row.kind
    if row.kind:
        raise RequestError(f"kind '{row.kind}' of clip '{row.clip}'; one of {', '.join(KINDS)}")
    if row.clip.lower().startswith("grid"):
        return "grid"
    if not row.what and len(rotations):
        return "head_motion" if np.median(rotations) >= HEAD_MOTION_DEGREES else "natural"
    words = "|".join(HEAD_MOTION_WORDS)
    return "head_motion" if re.search(rf"\b({words})\b", row.what.lower()) else "natural"


@dataclass(frozen=True)
class ClipFrames:
    """One clip at the rate of its sequences; NaN where there is no face.

    Attributes:
        landmarks: (T, 468, 3) float32 normalised image coordinates.
        valid: (T,) bool.
        interpolated: (T,) bool.
        timestamps: (T,) s on the video's clock.
        mouth: (T, 3) m, camera frame.
        orientation: (T, 4) wxyz, camera from head.
        jaw: (T,) m between the inner lips.
        source_frame: (T,) int: the decoded frame nearest in time; of two as near, the earlier.
        image_lag: (T,) s: time of that frame less that of this one.
        image_size: (width, height) in pixels.
        quality: of frames and steps.
    """

    landmarks: np.ndarray
    valid: np.ndarray
    interpolated: np.ndarray
    timestamps: np.ndarray
    mouth: np.ndarray
    orientation: np.ndarray
    jaw: np.ndarray
    source_frame: np.ndarray
    image_lag: np.ndarray
    image_size: Size
    quality: Quality

    def __len__(self) -> int:
        return len(self.valid)


@dataclass(frozen=True)
class Sequences:
    """Sequences of a clip.

    Attributes:
        start: (N,) int, first frames.
        crops: N crops.
        candidates: starts that were tried.
        dropped: how many were dropped for each of `REASONS`.
    """

    start: np.ndarray
    crops: tuple[Crop, ...]
    candidates: int
    dropped: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.start)


def clip_frames(track: FaceTrack, settings: SequenceSettings) -> ClipFrames:
    """Bring ``track`` to the rate of the sequences, lift it to metres and rate every frame.

    Raises:
        RequestError: the track shows no face.
    """
    if not track.valid.any():
        name = track.source.get("name", "track")
        raise RequestError(f"{name}: its track holds no frame with a face; leave this clip out")
    samples = Samples(track.timestamps, track.landmarks, track.head_pose, track.valid)
    interpolated, fps = track.interpolated, settings.fps
    if abs(track.fps - fps) >= 1e-6 * fps or not track.has_constant_rate:
        samples, made = resample(samples, fps)
        after = np.searchsorted(track.timestamps, samples.timestamps - SAME_TIME)
        after = np.clip(after, 0, len(track) - 1)
        before = np.maximum(after - 1, 0)
        guessed = track.interpolated[after] | (made & track.interpolated[before])
        interpolated = (made | guessed) & samples.valid
    mouth, orientation, jaw = lift_landmarks(samples.landmarks, samples.valid, track.image_size)
    times, wanted = track.source_timestamps, samples.timestamps
    decoded = nearest(wanted, times)
    return ClipFrames(
        landmarks=samples.landmarks.astype(np.float32),
        valid=samples.valid,
        interpolated=interpolated,
        timestamps=wanted,
        mouth=mouth,
        orientation=orientation,
        jaw=jaw,
        source_frame=decoded,
        image_lag=times[decoded] - wanted,
        image_size=track.image_size,
        quality=assess(mouth, orientation, jaw, fps, settings.limits),
    )


def nearest(wanted: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (T,) of the frame nearest to each of ``wanted`` (T,); of two as near, the earlier.

    ``times`` (N,) increase.
    """
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    is_later = wanted - times[before] > times[after] - wanted + SAME_TIME
    return np.where(is_later, after, before)


def find_sequences(frames: ClipFrames, settings: SequenceSettings) -> Sequences:
    """A sequence every ``stride`` frames, unless the face is lost or jumps in it."""
    length, quality = settings.length, frames.quality
    starts = range(0, len(frames) - length + 1, settings.stride)
    kept: list[int] = []
    dropped = dict.fromkeys(REASONS, 0)
    for start in starts:
        stop = start + length
        if not quality.found[start:stop].all():
            dropped["no_face"] += 1
        elif quality.jump[start : stop - 1].any():
            dropped["jump"] += 1
        elif quality.spike[start:stop].any():
            dropped["spike"] += 1
        else:
            kept.append(start)
    seen = settings.history if settings.crop_from == "history" else length
    faces = [frames.landmarks[start : start + seen] for start in kept]
    crops = tuple(crop_around(part, frames.image_size, settings.margin) for part in faces)
    return Sequences(np.array(kept, dtype=np.int64), crops, len(starts), dropped)


STATISTICS: dict[str, tuple[str, str]] = {
    "start_time": ("s", "Time of the first frame on the video's clock"),
    "mouth_range_u": ("crop", "Largest less smallest u of the mouth centre"),
    "mouth_range_v": ("crop", "Largest less smallest v of the mouth centre"),
    "mouth_range_x": ("m", "The same of its lifted position, x"),
    "mouth_range_y": ("m", "... y"),
    "mouth_range_z": ("m", "... z (away from the camera; the least certain)"),
    "head_rotation_range": ("deg", "Largest angle between the head's orientations in any two"),
    "mouth_opening_range": ("m", "Largest less smallest distance between the inner lips"),
    "interpolated_share": ("1", "Share of frames made from two decoded ones"),
    "image_lag": ("s", "Longest time between a frame and the picture that stands for it"),
    "crop_side": ("px", "Side of the crop in the video"),
    "crop_padding": ("1", "Share of the crop outside the video's picture (black)"),
    "outside_share": ("1", "Share of the frames to predict in which the face leaves the crop"),
}
"""Statistics of a sequence: name, unit and description, the columns of the table of sequences."""


def sequence_statistics(
    frames: ClipFrames, sequences: Sequences, settings: SequenceSettings
) -> dict[str, np.ndarray]:
    """The columns of `STATISTICS`, each (N,) float64."""
    rows: list[dict[str, Any]] = []
    for start, crop in zip(sequences.start.tolist(), sequences.crops, strict=True):
        part = slice(start, start + settings.length)
        points = crop.normalise(frames.landmarks[part], frames.image_size)[..., :2]  # (F, 468, 2)
        u, v = np.ptp(points[:, list(LIPS)].mean(axis=1), axis=0)
        x, y, z = np.ptp(frames.mouth[part], axis=0)
        future = points[settings.history :]
        outside = np.any((future < 0.0) | (future > 1.0), axis=(1, 2))
        rows.append(
            {
                "start_time": frames.timestamps[start],
                "mouth_range_u": u,
                "mouth_range_v": v,
                "mouth_range_x": x,
                "mouth_range_y": y,
                "mouth_range_z": z,
                "head_rotation_range": largest_angle(frames.orientation[part]),
                "mouth_opening_range": np.ptp(frames.jaw[part]),
                "interpolated_share": frames.interpolated[part].mean(),
                "image_lag": np.abs(frames.image_lag[part]).max(),
                "crop_side": crop.side,
                "crop_padding": crop.padding(frames.image_size),
                "outside_share": outside.mean(),
            }
        )
    return {name: np.array([row[name] for row in rows], dtype=np.float64) for name in STATISTICS}


def largest_angle(orientation: np.ndarray) -> float:
    """Largest angle in degrees between any two of the unit quaternions (F, 4)."""
    cosine = np.abs(orientation @ orientation.T).min()
    return float(np.degrees(2 * np.arccos(np.clip(cosine, 0.0, 1.0))))
