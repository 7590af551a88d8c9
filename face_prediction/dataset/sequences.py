"""A face track to frames at a constant rate, and the sequences that can be cut from them.

Legend: T frames, S decoded frames, N sequences, L = 468 landmarks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from face_prediction.dataset.settings import SequenceSettings
from face_prediction.motion.motion import Quality, assess, has_constant_rate
from face_prediction.tracking.crop import Crop, crop_around
from face_prediction.tracking.extract import SAME_TIME, Samples, resample
from face_prediction.tracking.geometry import quaternion_from_matrix, rigid_head_poses
from face_prediction.tracking.lifting import jaw_openings, mouth_centres
from face_prediction.tracking.tracks import FaceTrack
from robo_manip_baselines.runs.errors import RequestError

#: Why a sequence is dropped; the first that holds is counted.
REASONS: tuple[str, ...] = ("no_face", "jump", "spike")


@dataclass(frozen=True)
class ClipFrames:
    """One clip at the rate of its sequences; NaN where there is no face."""

    landmarks: np.ndarray  # (T, 468, 3) float32 normalised image coordinates
    valid: np.ndarray  # (T,) bool
    interpolated: np.ndarray  # (T,) bool
    timestamps: np.ndarray  # (T,) s on the video's clock
    mouth: np.ndarray  # (T, 3) m, camera frame
    orientation: np.ndarray  # (T, 4) wxyz, camera from head
    jaw: np.ndarray  # (T,) m between the inner lips
    source_frame: np.ndarray  # (T,) int: the decoded frame nearest in time
    image_lag: np.ndarray  # (T,) s: that frame's time less this one's
    image_size: tuple[int, int]
    quality: Quality

    def __len__(self) -> int:
        return len(self.valid)


@dataclass(frozen=True)
class Sequences:
    """Where the sequences of a clip start, their crops, and how many were dropped and why."""

    start: np.ndarray  # (N,) int
    crops: tuple[Crop, ...]  # N
    candidates: int
    dropped: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.start)


def clip_frames(track: FaceTrack, settings: SequenceSettings) -> ClipFrames:
    """Bring ``track`` to the rate of the sequences, lift it to metres and judge every frame.

    Raises:
        RequestError: the track shows no face.
    """
    if not track.valid.any():
        name = track.source.get("name", "track")
        raise RequestError(f"{name}: its track holds no frame with a face; leave this clip out")
    samples, interpolated = _at_rate(track, settings.fps)
    valid = samples.valid
    landmarks = samples.landmarks.astype(np.float64)
    pose = rigid_head_poses(landmarks, valid, track.image_size)
    mouth = mouth_centres(landmarks, pose, track.image_size)
    jaw = jaw_openings(landmarks, pose, track.image_size)
    orientation = np.full((len(valid), 4), np.nan)
    orientation[valid] = quaternion_from_matrix(pose[valid, :3, :3])
    nearest = _nearest(track.source_timestamps, samples.timestamps)
    return ClipFrames(
        landmarks=samples.landmarks.astype(np.float32),
        valid=valid,
        interpolated=interpolated,
        timestamps=samples.timestamps,
        mouth=mouth,
        orientation=orientation,
        jaw=jaw,
        source_frame=nearest,
        image_lag=track.source_timestamps[nearest] - samples.timestamps,
        image_size=track.image_size,
        quality=assess(mouth, orientation, jaw, settings.fps, settings.limits),
    )


def find_sequences(frames: ClipFrames, settings: SequenceSettings) -> Sequences:
    """Every ``stride`` frames a sequence, unless the face is lost or jumps in it."""
    length = settings.length
    starts = range(0, len(frames) - length + 1, settings.stride)
    kept: list[int] = []
    dropped: dict[str, int] = dict.fromkeys(REASONS, 0)
    for start in starts:
        reason = why_dropped(frames.quality, start, start + length)
        if reason is None:
            kept.append(start)
        else:
            dropped[reason] += 1
    seen = settings.history if settings.crop_from == "history" else length
    crops = tuple(
        crop_around(frames.landmarks[s : s + seen], frames.image_size, settings.margin)
        for s in kept
    )
    return Sequences(np.array(kept, dtype=np.int64), crops, len(starts), dropped)


def why_dropped(quality: Quality, start: int, stop: int) -> str | None:
    """The first of `REASONS` that holds in frames [start, stop), or None."""
    if not quality.found[start:stop].all():
        return "no_face"
    if quality.jump[start : stop - 1].any():
        return "jump"
    # the ends of a sequence are no spikes of its own: a spike needs both neighbours
    if quality.spike[start:stop].any():
        return "spike"
    return None


def _at_rate(track: FaceTrack, fps: float) -> tuple[Samples, np.ndarray]:
    samples = Samples(track.timestamps, track.landmarks, track.head_pose, track.valid)
    if abs(track.fps - fps) < 1e-6 * fps and has_constant_rate(track):
        return samples, track.interpolated
    resampled, made = resample(samples, fps)
    after = np.searchsorted(track.timestamps, resampled.timestamps - SAME_TIME)
    after = np.clip(after, 0, len(track) - 1)
    before = np.maximum(after - 1, 0)
    guessed = track.interpolated[after] | (made & track.interpolated[before])
    return resampled, (made | guessed) & resampled.valid


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index into increasing ``times`` (S,) of the one nearest to each of ``wanted`` (T,).

    Of two as near, the earlier one.
    """
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    later = wanted - times[before] > times[after] - wanted + SAME_TIME
    return np.where(later, after, before)
