"""Face tracks to recorded motion: lift, judge, cut into runs.

Legend: T frames of a clip.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from face_prediction.errors import RequestError
from face_prediction.lifting import jaw_openings, mouth_centres
from face_prediction.quality import Quality, QualityLimits, assess, tremor
from face_prediction.rigid_pose import rigid_head_poses
from face_prediction.rotations import continuous_quaternions, quaternion_from_matrix
from face_prediction.runs import longest_runs, permitted_starts
from face_prediction.tracks import FaceTrack


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
