"""Where a lifted motion may be trusted: detector jumps, dropped faces, heads turned away.

Nothing is repaired here. Frames and steps that fail are cut out, and counted.

Legend: T frames; a step is the way from one frame to the next, so there are T - 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from face_prediction.tracking.geometry import (
    continuous_quaternions,
    quaternion_from_matrix,
    rigid_head_poses,
    rotation_angle,
)
from face_prediction.tracking.lifting import jaw_openings, mouth_centres
from face_prediction.tracking.tracks import FaceTrack
from robo_manip_baselines.runs.errors import RequestError

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


def permitted_starts(mouth: np.ndarray, window: int, max_displacement: float) -> np.ndarray:
    """(T - W + 1,) bool: from which frames a window of W frames stays within reach.

    Within reach: no axis of ``mouth`` (T, 3) goes further than ``max_displacement`` metres from
    where it was in the window's first frame.
    """
    if len(mouth) < window:
        return np.zeros(0, dtype=bool)
    views = np.lib.stride_tricks.sliding_window_view(mouth, window, axis=0)  # (N, 3, W)
    start = mouth[: len(views)]
    reach = np.maximum(views.max(axis=2) - start, start - views.min(axis=2))
    return np.all(reach <= max_displacement, axis=1)


def longest_runs(permitted: np.ndarray, window: int) -> list[tuple[int, int]]:
    """Disjoint [start, stop) runs that hold the most frames and permit every start in them.

    Dynamic programming over the frame where a run stops: a run that stops at e may begin at any s
    for which all starts s ... e - W are permitted.
    """
    frames = len(permitted) + window - 1
    best = np.zeros(frames + 1, dtype=int)  # most frames in runs that stop by here
    chosen: list[int | None] = [None] * (frames + 1)  # where the run that stops here begins
    open_start: int | None = None  # best beginning among the permitted starts up to e - W
    for stop in range(1, frames + 1):
        best[stop] = best[stop - 1]
        last_start = stop - window
        if last_start < 0:
            continue
        if not permitted[last_start]:
            open_start = None
            continue
        if open_start is None or best[last_start] - last_start > best[open_start] - open_start:
            open_start = last_start
        held = best[open_start] + stop - open_start
        if held > best[stop]:
            best[stop] = held
            chosen[stop] = open_start
    runs: list[tuple[int, int]] = []
    stop = frames
    while stop > 0:
        start = chosen[stop]
        if start is None:
            stop -= 1
        else:
            runs.append((start, stop))
            stop = start
    return runs[::-1]


@dataclass(frozen=True)
class MotionSettings:
    """How motion is lifted, judged and cut; recorded in the library."""

    limits: QualityLimits = field(default_factory=QualityLimits)
    #: seconds of an episode: the shortest run, and the window that must stay within reach
    min_run: float = 12.0
    #: metres on each axis from where a window starts
    max_displacement: float = 0.08
    #: Hz (-3 dB) of the low-pass on the depth of clips that need it; None: never
    depth_cutoff: float | None = 3.0
    #: metres: clips whose depth trembles more than this from frame to frame need it
    max_depth_tremor: float = 0.001

    def __post_init__(self) -> None:
        for name in ("min_run", "max_displacement", "depth_cutoff", "max_depth_tremor"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise RequestError(f"--{name} {value}: must be positive")


@dataclass(frozen=True)
class ClipMotion:
    """The motion of one clip, and what of it is kept."""

    fps: float
    timestamps: np.ndarray  # (T,) s
    mouth: np.ndarray  # (T, 3) m, camera frame; NaN where lost
    raw_depth: np.ndarray  # (T,) m, z before any low-pass
    orientation: np.ndarray  # (T, 4) wxyz, camera from head
    jaw: np.ndarray  # (T,) m
    quality: Quality
    depth_smoothed: bool
    window: int  # frames of an episode
    runs: list[tuple[int, int]]  # [start, stop)
    counts: dict[str, Any]  # what was cut and why


def lift(track: FaceTrack, settings: MotionSettings) -> ClipMotion:
    """Lift ``track`` to metres, judge every frame, and choose the runs to keep.

    Raises:
        RequestError: the track's frames are not at a constant rate.
    """
    if not has_constant_rate(track):
        raise RequestError(
            f"{track.source.get('name', 'track')}: its frames are not at a constant rate; "
            "extract it with --fps 30"
        )
    landmarks = track.landmarks.astype(float)
    head_pose = rigid_head_poses(landmarks, track.valid, track.image_size)
    mouth = mouth_centres(landmarks, head_pose, track.image_size)
    jaw = jaw_openings(landmarks, head_pose, track.image_size)
    orientation = np.full((len(track), 4), np.nan)
    valid = track.valid
    orientation[valid] = quaternion_from_matrix(head_pose[valid, :3, :3])
    quality = assess(mouth, orientation, jaw, track.fps, settings.limits)
    raw_depth = mouth[:, 2].copy()
    shaky = step_tremor(raw_depth) > settings.max_depth_tremor
    smoothed = settings.depth_cutoff is not None and shaky
    for start, stop in quality.segments():
        part = slice(start, stop)
        orientation[part] = continuous_quaternions(orientation[part])
        if smoothed and settings.depth_cutoff is not None:
            mouth[part] = smooth_depth(mouth[part], settings.depth_cutoff / track.fps)
    window = round(settings.min_run * track.fps) + 1
    runs: list[tuple[int, int]] = []
    for start, stop in quality.facing_segments():
        permitted = permitted_starts(mouth[start:stop], window, settings.max_displacement)
        runs += [(start + a, start + b) for a, b in longest_runs(permitted, window)]
    counts = count_cuts(quality, runs, window)
    return ClipMotion(
        fps=track.fps,
        timestamps=track.timestamps,
        mouth=mouth,
        raw_depth=raw_depth,
        orientation=orientation,
        jaw=jaw,
        quality=quality,
        depth_smoothed=smoothed,
        window=window,
        runs=runs,
        counts=counts,
    )


def has_constant_rate(track: FaceTrack) -> bool:
    """Whether frames are 1 / fps apart, to a millisecond (container clocks tick that coarsely)."""
    return bool(np.all(np.abs(np.diff(track.timestamps) - 1 / track.fps) < 1e-3))


def step_tremor(depth: np.ndarray) -> float:
    """Frame-to-frame standard deviation in metres of the noise on a depth (T,)."""
    return float(np.sqrt(2) * tremor(depth))


def smooth_depth(mouth: np.ndarray, cutoff: float) -> np.ndarray:
    """Mouth centres (T, 3) moved along their camera rays to low-passed depths.

    A zero-phase Gaussian, -3 dB at ``cutoff`` (cycles per frame); where the mouth is seen in the
    image stays as it was. The ends are continued by point reflection, so that a steady approach
    keeps its slope there.
    """
    sigma = np.sqrt(np.log(2)) / (2 * np.pi * cutoff)  # exp(-2 (pi sigma f)^2) = 1 / sqrt(2)
    reach = min(int(np.ceil(4 * sigma)), len(mouth) - 1)
    if reach < 1:
        return mouth.copy()
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(mouth[:, 2], reach, mode="reflect", reflect_type="odd")
    depth = np.convolve(padded, kernel / kernel.sum(), mode="valid")
    return mouth * (depth / mouth[:, 2])[:, None]


def count_cuts(quality: Quality, runs: list[tuple[int, int]], window: int) -> dict[str, int]:
    """Frames of the clip by what became of them; the five add up to all of them."""
    kept = np.zeros(len(quality.found), dtype=bool)
    for start, stop in runs:
        kept[start:stop] = True
    lost = ~quality.found
    spike = quality.spike & ~lost
    turned = quality.turned_away & ~lost & ~spike
    short = np.zeros_like(kept)
    reachless = np.zeros_like(kept)
    for start, stop in quality.facing_segments():
        (short if stop - start < window else reachless)[start:stop] = True
    return {
        "frames": len(kept),
        "kept": int(kept.sum()),
        "no_face": int(lost.sum()),
        "spike": int(spike.sum()),
        "turned_away": int(turned.sum()),
        "too_short": int(short.sum()),
        "out_of_reach": int((reachless & ~kept).sum()),
        "jumps": int(quality.jump.sum()),
        "runs": len(runs),
    }
