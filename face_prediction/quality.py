"""Where a lifted motion may be trusted: detector jumps, dropped faces, heads turned away.

Nothing is repaired here. Frames and steps that fail are cut out, and counted.

Legend: T frames; a step is the way from one frame to the next, so there are T - 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from face_prediction.errors import RequestError
from face_prediction.rotations import rotation_angle

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
#: Standard deviation of a normal distribution in units of its median absolute deviation.
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class QualityLimits:
    """What a head can do; more than this is the detector's doing (docs/face_motion.md)."""

    #: m/s, mouth across the view
    max_speed: float = 0.6
    #: m/s^2, mouth across the view
    max_acceleration: float = 15.0
    #: degrees/s, head
    max_turn_rate: float = 400.0
    #: m/s, lips apart or together
    max_jaw_speed: float = 0.6
    #: Depth is measured by the size of the face and trembles more the smaller it is: a step in
    #: depth is a jump beyond max_speed and this many standard deviations of the clip's own tremor.
    depth_sigmas: float = 4.0
    #: degrees between the head and facing the camera
    max_rotation: float = 35.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise RequestError(f"--{name} {value}: must be positive")


@dataclass(frozen=True)
class Quality:
    """Verdict on every frame and step of one motion."""

    #: (T,) bool: a face was found and its mouth could be placed
    found: np.ndarray
    #: (T,) bool: the frame is the top of a spike
    spike: np.ndarray
    #: (T - 1,) bool: the step is a jump
    jump: np.ndarray
    #: (T,) bool: the head is turned away too far
    turned_away: np.ndarray

    def segments(self) -> list[tuple[int, int]]:
        """[start, stop) of every stretch without a lost face, a spike or a jump inside it."""
        return stretches(self.found & ~self.spike, self.jump)

    def facing_segments(self) -> list[tuple[int, int]]:
        """The same, split again where the head is turned away."""
        return stretches(self.found & ~self.spike & ~self.turned_away, self.jump)


def assess(
    mouth: np.ndarray, orientation: np.ndarray, jaw: np.ndarray, fps: float, limits: QualityLimits
) -> Quality:
    """Judge a motion: mouth (T, 3) m, orientation (T, 4) wxyz, jaw (T,) m; NaN where lost."""
    found = np.isfinite(mouth).all(axis=1) & np.isfinite(jaw) & np.isfinite(orientation).all(axis=1)
    velocity = np.diff(mouth, axis=0) * fps
    across = np.linalg.norm(velocity[:, :2], axis=1)
    allowance = limits.depth_sigmas * np.sqrt(2) * tremor(mouth[:, 2]) * fps
    turn = np.degrees(rotation_angle(orientation[1:], orientation[:-1])) * fps
    jaw_speed = np.abs(np.diff(jaw)) * fps
    # comparisons with NaN are False: a lost face is counted as that, not as a jump
    jump = (
        (across > limits.max_speed)
        | (np.abs(velocity[:, 2]) > limits.max_speed + allowance)
        | (turn > limits.max_turn_rate)
        | (jaw_speed > limits.max_jaw_speed)
    )
    spike = np.zeros(len(mouth), dtype=bool)
    acceleration = np.linalg.norm(np.diff(velocity[:, :2], axis=0), axis=1) * fps
    spike[1:-1] = acceleration > limits.max_acceleration
    angle = np.degrees(rotation_angle(orientation, IDENTITY))
    return Quality(found, spike, jump, angle > limits.max_rotation)


def tremor(values: np.ndarray) -> float:
    """Robust standard deviation of the noise on a smooth signal (T,), from second differences.

    White noise of standard deviation s has second differences of s * sqrt(6); the median keeps
    true motion, which is smooth at frame rate, from counting. 0 with fewer than three frames.
    """
    second = np.diff(values, n=2)
    second = second[np.isfinite(second)]
    if len(second) == 0:
        return 0.0
    return float(MAD_TO_SIGMA * np.median(np.abs(second)) / np.sqrt(6))


def stretches(good: np.ndarray, broken_step: np.ndarray) -> list[tuple[int, int]]:
    """[start, stop) of every longest stretch of ``good`` (T,) frames without a broken step."""
    result: list[tuple[int, int]] = []
    start: int | None = None
    for index, frame_good in enumerate(good):
        if start is not None and (not frame_good or broken_step[index - 1]):
            result.append((start, index))
            start = None
        if start is None and frame_good:
            start = index
    if start is not None:
        result.append((start, len(good)))
    return result
