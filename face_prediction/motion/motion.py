"""Motion of mouth, head and jaw lifted from a track, rated frame by frame and cut into runs.

Detector jumps, dropped faces and heads turned away are not repaired. Frames and steps that fail are
cut out, and counted.

Legend: T frames; a step is the way from one frame to the next, so there are T - 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from face_prediction.tracking.geometry import continuous_quaternions, lift_landmarks, rotation_angle
from face_prediction.tracking.tracks import FaceTrack
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Positive, require_ranges

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""


@dataclass(frozen=True)
class QualityLimits:
    """Limits of human motion; anything beyond is an error of the detector (docs/face_motion.md).

    Attributes:
        max_speed: m/s across the view; a faster mouth is a jump of the detector.
        max_acceleration: m/s^2 of the mouth across the view; more is a spike.
        max_turn_rate: degrees/s; a faster head is a jump.
        max_jaw_speed: m/s between the lips; more is a jump.
        depth_sigmas: A step in depth is a jump beyond max_speed and this many standard deviations
            of the clip's own tremor in depth, which is measured by the size of the face and grows
            as the face gets smaller.
        max_rotation: Degrees between the head and facing the camera.
    """

    max_speed: Positive = 0.6
    max_acceleration: Positive = 15.0
    max_turn_rate: Positive = 400.0
    max_jaw_speed: Positive = 0.6
    depth_sigmas: Positive = 4.0
    max_rotation: Positive = 35.0

    def __post_init__(self) -> None:
        require_ranges(self, "--{} {}")


@dataclass(frozen=True)
class Quality:
    """Quality of every frame and step of one motion.

    Attributes:
        found: (T,) bool: a face was found and its mouth could be placed.
        spike: (T,) bool: the frame is the top of a spike.
        jump: (T - 1,) bool: the step is a jump.
        turned_away: (T,) bool: the head is turned away too far.
    """

    found: np.ndarray
    spike: np.ndarray
    jump: np.ndarray
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
    """Rate a motion: mouth (T, 3) m, orientation (T, 4) wxyz, jaw (T,) m; NaN where lost."""
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
    joined = good[1:] & good[:-1] & ~broken_step  # (T - 1,) both frames are in one stretch
    starts = np.flatnonzero(good & ~np.concatenate([[False], joined]))
    stops = np.flatnonzero(good & ~np.concatenate([joined, [False]])) + 1
    return list(zip(starts.tolist(), stops.tolist(), strict=True))


def permitted_starts(mouth: np.ndarray, window: int, max_displacement: float) -> np.ndarray:
    """(T - W + 1,) bool: a window of W frames from this frame stays within reach.

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
    """Settings of lifting, rating and cutting motion; recorded in the library.

    Attributes:
        limits: Limits of human motion.
        min_run: Seconds of an episode: runs are at least this long, and from every start that
            leaves this much, the mouth stays within reach.
        max_displacement: Reach in metres on each axis from where an episode starts.
        depth_cutoff: Hz (-3 dB) of the low-pass on the depth of clips that need it; None: keep
            every depth as measured.
        max_depth_tremor: Metres: clips whose depth trembles more than this from frame to frame get
            the low-pass.
    """

    limits: QualityLimits = field(default_factory=QualityLimits)
    min_run: Positive = 12.0
    max_displacement: Positive = 0.08
    depth_cutoff: Positive | None = 3.0
    max_depth_tremor: Positive = 0.001

    def __post_init__(self) -> None:
        require_ranges(self, "--{} {}")

    def window(self, fps: float) -> int:
        """Frames of an episode at ``fps`` frames per second, two or more."""
        return max(round(self.min_run * fps), 1) + 1


@dataclass(frozen=True)
class ClipMotion:
    """Motion of one clip, and the runs of it that are kept.

    Attributes:
        fps: frames per second.
        timestamps: (T,) s.
        mouth: (T, 3) m, camera frame; NaN where lost.
        raw_depth: (T,) m, z before any low-pass.
        orientation: (T, 4) wxyz, camera from head.
        jaw: (T,) m between the inner lips.
        quality: of frames and steps.
        depth_smoothed: the depth was low-passed.
        window: frames of an episode.
        runs: [start, stop) of each run.
    """

    fps: float
    timestamps: np.ndarray
    mouth: np.ndarray
    raw_depth: np.ndarray
    orientation: np.ndarray
    jaw: np.ndarray
    quality: Quality
    depth_smoothed: bool
    window: int
    runs: list[tuple[int, int]]

    @property
    def seconds(self) -> float:
        """Continuous motion kept: the time from first to last frame, summed over runs."""
        return sum(stop - start - 1 for start, stop in self.runs) / self.fps

    def frame_classes(self) -> dict[str, np.ndarray]:
        """Masks (T,) of frames by what became of them; every frame is in one of them."""
        quality = self.quality
        kept, short, rest = np.zeros((3, len(self.timestamps)), dtype=bool)
        for start, stop in self.runs:
            kept[start:stop] = True
        for start, stop in quality.facing_segments():
            (short if stop - start < self.window else rest)[start:stop] = True
        spike = quality.spike & quality.found
        return {
            "kept": kept,
            "no_face": ~quality.found,
            "spike": spike,
            "turned_away": quality.turned_away & quality.found & ~spike,
            "too_short": short,
            "out_of_reach": rest & ~kept,
        }

    def counts(self) -> dict[str, int]:
        """Frames by what became of them, jumps and runs."""
        return {
            "frames": len(self.timestamps),
            **{name: int(mask.sum()) for name, mask in self.frame_classes().items()},
            "jumps": int(self.quality.jump.sum()),
            "runs": len(self.runs),
        }


def lift(track: FaceTrack, settings: MotionSettings) -> ClipMotion:
    """Lift ``track`` to metres, rate every frame, and choose the runs to keep.

    Raises:
        RequestError: the track's frames are not at a constant rate.
    """
    if not track.has_constant_rate:
        wrong = "its frames are not at a constant rate; extract it with --fps 30"
        raise RequestError(f"{track.source.get('name', 'track')}: {wrong}")
    mouth, orientation, jaw = lift_landmarks(track.landmarks, track.valid, track.image_size)
    quality = assess(mouth, orientation, jaw, track.fps, settings.limits)
    raw_depth = mouth[:, 2].copy()
    shaky = step_tremor(raw_depth) > settings.max_depth_tremor
    cutoff = settings.depth_cutoff if shaky else None
    for start, stop in quality.segments():
        part = slice(start, stop)
        orientation[part] = continuous_quaternions(orientation[part])
        if cutoff is not None:
            mouth[part] = smooth_depth(mouth[part], cutoff / track.fps)
    window = settings.window(track.fps)
    return ClipMotion(
        fps=track.fps,
        timestamps=track.timestamps,
        mouth=mouth,
        raw_depth=raw_depth,
        orientation=orientation,
        jaw=jaw,
        quality=quality,
        depth_smoothed=cutoff is not None,
        window=window,
        runs=cut_runs(mouth, quality, window, settings.max_displacement),
    )


def cut_runs(
    mouth: np.ndarray, quality: Quality, window: int, max_displacement: float
) -> list[tuple[int, int]]:
    """[start, stop) of the runs to keep of a motion, see `longest_runs`.

    Args:
        mouth: (T, 3) m.
        quality: of its frames and steps.
        window: frames of an episode.
        max_displacement: m, reach on each axis from where an episode starts.
    """
    runs: list[tuple[int, int]] = []
    for start, stop in quality.facing_segments():
        permitted = permitted_starts(mouth[start:stop], window, max_displacement)
        runs += [(start + a, start + b) for a, b in longest_runs(permitted, window)]
    return runs


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
