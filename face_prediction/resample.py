"""Decoded frames at their own times to a constant rate, without bridging a gap.

Legend: S source frames, T frames, L landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from face_prediction.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp

#: Two decoded frames further apart than this are a gap: at 0.1 s a mouth at the median speed
#: (1-4 cm/s) has gone 4 mm, and nothing says which way.
MAX_GAP = 0.1
#: A frame nearer than this to a decoded one is that frame (video clocks tick in 1/90000 s or more).
SAME_TIME = 1e-3


@dataclass(frozen=True)
class Samples:
    """Detections at their times: landmarks (T, L, 3), head_pose (T, 4, 4), valid (T,)."""

    timestamps: np.ndarray
    landmarks: np.ndarray
    head_pose: np.ndarray
    valid: np.ndarray


def resample(source: Samples, fps: float, max_gap: float = MAX_GAP) -> tuple[Samples, np.ndarray]:
    """Samples every 1/fps seconds from the first source time to the last, and which were made.

    A frame that falls between two decoded frames is interpolated (landmarks and position linearly,
    rotation along the arc) when both are valid and no more than ``max_gap`` seconds apart;
    otherwise it is invalid and NaN. Returns the samples and ``interpolated`` (T,) bool.
    """
    times = source.timestamps
    count = int(np.floor((times[-1] - times[0]) * fps + 1e-6)) + 1
    wanted = times[0] + np.arange(count) / fps
    after = np.clip(np.searchsorted(times, wanted, side="right"), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    gap = times[after] - times[before]
    weight = np.clip((wanted - times[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    # a frame at a decoded time needs nothing from its neighbour
    weight = np.where(np.abs(wanted - times[before]) < SAME_TIME, 0.0, weight)
    weight = np.where(np.abs(wanted - times[after]) < SAME_TIME, 1.0, weight)
    between = (weight > 0.0) & (weight < 1.0)
    nearest = np.where(weight == 1.0, after, before)
    valid = np.where(
        between,
        source.valid[before] & source.valid[after] & (gap <= max_gap + 1e-6),
        source.valid[nearest],
    )
    landmarks = _mix(source.landmarks, before, after, weight)
    head_pose = _mix_poses(source.head_pose, before, after, weight)
    landmarks[~valid] = np.nan
    head_pose[~valid] = np.nan
    return Samples(wanted, landmarks, head_pose, valid), between & valid


def _mix(
    array: np.ndarray, before: np.ndarray, after: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    filled = np.nan_to_num(array)  # NaN * 0 would spoil a frame that its neighbour does not enter
    w = weight.reshape(-1, *([1] * (array.ndim - 1)))
    return (1 - w) * filled[before] + w * filled[after]


def _mix_poses(
    poses: np.ndarray, before: np.ndarray, after: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    mixed = _mix(poses, before, after, weight)
    known = np.where(np.isfinite(poses[:, :1, :1]), poses[:, :3, :3], np.eye(3))
    quaternion = quaternion_from_matrix(known)
    mixed[:, :3, :3] = matrix_from_quaternion(slerp(quaternion[before], quaternion[after], weight))
    mixed[:, 3] = (0.0, 0.0, 0.0, 1.0)
    return mixed
