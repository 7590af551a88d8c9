"""Spliced motion: short stretches of one person joined to runs as long as an episode.

Most recordings of a person are shorter than an episode. A splice blends from the end of one stretch
into the beginning of another where the two are most alike; each sample records whether it was
blended and whether it is played backwards, so that nobody takes it for one recording.

Legend: T frames, B frames of a blend, W frames of the search for its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from face_prediction.motion.motion import (
    ClipMotion,
    MotionSettings,
    assess,
    cut_runs,
    stretches,
)
from face_prediction.tracking.geometry import continuous_quaternions, rotation_angle, slerp
from robo_manip_baselines.runs.ranges import Positive, require_ranges

SUFFIX = "_spliced"
"""Ends the names of clips that were made of a person's stretches."""


@dataclass(frozen=True)
class SpliceSettings:
    """Settings of spliced motion; recorded in the library.

    Attributes:
        splice: Join what is left of each person's clips to runs, after those of one take.
        mirror: Play a stretch backwards, once, when none forwards is left that fits.
        blend: Seconds of a blend.
        search: Seconds at either end of a stretch within which a blend is placed.
        min_stretch: Seconds of the shortest stretch that is used.
        max_turn: Degrees between two heads that are blended, on average.
        max_spliced: Seconds of spliced motion of one person, at most.
    """

    splice: bool = False
    mirror: bool = False
    blend: Positive = 0.4
    search: Positive = 0.3
    min_stretch: Positive = 1.25
    max_turn: Positive = 12.0
    max_spliced: Positive = 75.0

    def __post_init__(self) -> None:
        require_ranges(self, "--{} {}")


@dataclass(frozen=True)
class Stretch:
    """Stretch of a clip without a cut inside it, perhaps backwards.

    Attributes:
        clip: its name.
        first: number of its first frame in the clip, before it was turned round.
        is_mirrored: it is played backwards.
        mouth: (T, 3) m.
        orientation: (T, 4) wxyz.
        jaw: (T,) m.
    """

    clip: str
    first: int
    is_mirrored: bool
    mouth: np.ndarray
    orientation: np.ndarray
    jaw: np.ndarray

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mouth, orientation and jaw."""
        return self.mouth, self.orientation, self.jaw

    @property
    def marks(self) -> np.ndarray:
        """(T,) bool: each sample is played backwards."""
        return np.full(len(self.jaw), self.is_mirrored)

    def mirrored(self) -> Stretch:
        """Return the stretch played backwards."""
        backwards = (array[::-1] for array in self.arrays)
        return Stretch(self.clip, self.first, not self.is_mirrored, *backwards)


@dataclass(frozen=True)
class Join:
    """Blend of two stretches.

    Attributes:
        leave: frame of the first stretch at which the blend begins.
        enter: frame of the second one, likewise.
        turn: degrees between the two heads, mean over the blend.
        cost: of differences in pose and velocity, see `best_join`.
    """

    leave: int
    enter: int
    turn: float
    cost: float


@dataclass(frozen=True)
class SplicedClip:
    """Spliced motion of one person.

    Attributes:
        name: of the clip that it stands for.
        subject: the person.
        motion: as if it had been one clip, cut into runs by the same limits.
        blended: (T,) bool: the sample is a blend of two recorded ones.
        mirrored: (T,) bool: the sample, or one of the two, is played backwards.
        stretches: clip, first frame, number of frames and direction of all that was joined.
    """

    name: str
    subject: str
    motion: ClipMotion
    blended: np.ndarray
    mirrored: np.ndarray
    stretches: list[dict[str, Any]]

    def kept(self, values: np.ndarray) -> np.ndarray:
        """Return what of ``values`` (T,) is of the runs."""
        return np.concatenate([values[start:stop] for start, stop in self.motion.runs])

    @property
    def clips(self) -> list[str]:
        """Names of the clips that it is made of, in order."""
        return list(dict.fromkeys(str(stretch["clip"]) for stretch in self.stretches))


def smooth_step(phase: np.ndarray) -> np.ndarray:
    """Weight (B,) from 0 to 1 at phases 0 ... 1 whose first two derivatives vanish at both ends.

    A blend with it has position, velocity and acceleration of the first stretch where it begins and
    of the second one where it ends.
    """
    return phase**3 * (10.0 + phase * (6.0 * phase - 15.0))


def best_join(
    first: Stretch, second: Stretch, begin: int, blend: int, search: int, fps: float
) -> Join | None:
    """Find where two stretches are most alike; None where there is no room for a blend.

    The cost of a place is the mean over the blend of the squared differences of head (in 5
    degrees), velocity of the mouth (in 0.05 m/s) and jaw (in 3 mm), each a small one that is seen.
    Where the mouth is does not count, as the second stretch is moved to the first.

    Args:
        first: stretch that is left.
        second: stretch that is entered.
        begin: first frame of ``first`` that may be blended; those before are in another blend.
        blend: B, frames of the blend; it has one more, which is of the second stretch alone.
        search: W, frames from the end of ``first`` and the start of ``second``.
        fps: frames per second.
    """
    last = len(first.jaw) - blend - 1
    leaves = np.arange(max(begin, last - search), last + 1)
    # Of the second one, as much as a blend is left as recorded before the next blend.
    enters = np.arange(0, min(search, len(second.jaw) - 3 * blend - 1) + 1)
    if not len(leaves) or not len(enters):
        return None
    a = leaves[:, None, None] + np.arange(blend + 1)
    b = enters[None, :, None] + np.arange(blend + 1)
    turn = np.degrees(rotation_angle(first.orientation[a], second.orientation[b]))
    slower, faster = (np.gradient(s.mouth, axis=0) * fps for s in (first, second))
    speed = np.linalg.norm(slower[a] - faster[b], axis=-1)
    jaw = first.jaw[a] - second.jaw[b]
    cost = np.mean((turn / 5.0) ** 2 + (speed / 0.05) ** 2 + (jaw / 0.003) ** 2, axis=-1)
    row, column = np.unravel_index(int(np.argmin(cost)), cost.shape)
    mean_turn = float(turn.mean(axis=-1)[row, column])
    return Join(int(leaves[row]), int(enters[column]), mean_turn, float(cost[row, column]))


class _Chain:
    """Stretches joined so far: mouth, orientation, jaw, and the two marks of each sample."""

    def __init__(self, first: Stretch, blend: int) -> None:
        self.blend, self.begin, self.stretches = blend, blend, [first]
        self.parts = [*first.arrays, np.zeros(len(first.jaw), dtype=bool), first.marks]

    def __len__(self) -> int:
        return len(self.parts[0])

    def append(self, stretch: Stretch, join: Join) -> None:
        """Blend into another stretch, moved to where the mouth is."""
        blend, last = self.blend, self.stretches[-1]
        start = len(self) - len(last.jaw) + join.leave
        ahead = slice(join.enter, join.enter + blend + 1)
        old = [part[start : start + blend + 1] for part in self.parts]
        moved = stretch.mouth + np.mean(old[0] - stretch.mouth[ahead], axis=0)
        weight = smooth_step(np.arange(blend + 1) / blend)
        joined = [
            old[0] + weight[:, None] * (moved[ahead] - old[0]),
            slerp(old[1], stretch.orientation[ahead], weight),
            old[2] + weight * (stretch.jaw[ahead] - old[2]),
            (weight > 0) & (weight < 1),
            np.where(weight < 1, old[4], False) | np.where(weight > 0, stretch.marks[ahead], False),
        ]
        after = [moved, stretch.orientation, stretch.jaw, np.zeros_like(stretch.marks)]
        rest = [part[ahead.stop :] for part in (*after, stretch.marks)]
        parts = zip(self.parts, joined, rest, strict=True)
        self.parts = [np.concatenate([part[:start], new, end]) for part, new, end in parts]
        self.stretches.append(stretch)
        self.begin = join.enter + 2 * blend  # between two blends, as much is as recorded


def join_stretches(given: Sequence[Stretch], settings: SpliceSettings, fps: float) -> list[_Chain]:
    """Join the stretches of one person, each once and, mirrored, once more.

    The first one begins; the one that fits best follows. A mirrored one follows where none
    forwards fits; where none fits at all, the next chain begins.
    """
    blend, search = round(settings.blend * fps), round(settings.search * fps)
    left = list(given)
    turned = [stretch.mirrored() for stretch in given] if settings.mirror else []
    chains: list[_Chain] = []
    frames = 0
    while left and frames < settings.max_spliced * fps:
        chain = _Chain(left.pop(0), blend)
        while frames + len(chain) < settings.max_spliced * fps:
            last = chain.stretches[-1]
            for pool in (left, turned):
                joins = [best_join(last, s, chain.begin, blend, search, fps) for s in pool]
                fitting = [
                    (join.cost, number, join)
                    for number, join in enumerate(joins)
                    if join is not None and join.turn <= settings.max_turn
                ]
                if fitting:
                    _, number, join = min(fitting, key=lambda item: item[:2])
                    chain.append(pool.pop(number), join)
                    break
            else:
                break
        frames += len(chain)
        chains.append(chain)
    return chains


def splice_clips(
    clips: Sequence[tuple[str, str, ClipMotion]], settings: SpliceSettings, cuts: MotionSettings
) -> list[SplicedClip]:
    """Splice what the runs of clips have left over, person by person.

    Args:
        clips: name, subject and motion of each.
        settings: of the splices.
        cuts: what a run must be like, spliced or not.
    """
    spliced: list[SplicedClip] = []
    for person in dict.fromkeys(subject for _, subject, _ in clips):
        own = [(name, motion) for name, subject, motion in clips if subject == person]
        given = [s for name, motion in own for s in _left_over(name, motion, settings)]
        if not given:
            continue
        fps = own[0][1].fps
        window = round(cuts.min_run * fps) + 1
        chains = join_stretches(given, settings, fps)
        long_enough = [chain for chain in chains if len(chain) >= window]
        for number, chain in enumerate(long_enough):
            name = f"{person}{SUFFIX}" + (f"_{number + 1}" if number else "")
            used = {stretch.clip for stretch in chain.stretches}
            smoothed = any(motion.depth_smoothed for clip, motion in own if clip in used)
            clip = _cut(name, person, chain, fps, cuts, smoothed)
            if clip.motion.runs:
                spliced.append(clip)
    return spliced


def _left_over(name: str, motion: ClipMotion, settings: SpliceSettings) -> list[Stretch]:
    """Return the stretches of a clip that are in none of its runs and long enough."""
    free = np.zeros(len(motion.timestamps), dtype=bool)
    found: list[Stretch] = []
    for start, stop in motion.quality.facing_segments():
        free[start:stop] = True
    for start, stop in motion.runs:
        free[start:stop] = False
    for start, stop in stretches(free, motion.quality.jump):
        if stop - start > settings.min_stretch * motion.fps:
            part = slice(start, stop)
            arrays = motion.mouth[part], motion.orientation[part], motion.jaw[part]
            found.append(Stretch(name, start, False, *arrays))
    return found


def _cut(
    name: str, person: str, chain: _Chain, fps: float, cuts: MotionSettings, is_smoothed: bool
) -> SplicedClip:
    """Cut a chain into runs as if it were one clip."""
    mouth, orientation, jaw, blended, mirrored = chain.parts
    orientation = continuous_quaternions(orientation)
    quality = assess(mouth, orientation, jaw, fps, cuts.limits)
    window = round(cuts.min_run * fps) + 1
    motion = ClipMotion(
        fps=fps,
        timestamps=np.arange(len(jaw)) / fps,
        mouth=mouth,
        raw_depth=mouth[:, 2].copy(),
        orientation=orientation,
        jaw=jaw,
        quality=quality,
        depth_smoothed=is_smoothed,
        window=window,
        runs=cut_runs(mouth, quality, window, cuts.max_displacement),
    )
    records = [
        {"clip": s.clip, "first": s.first, "frames": len(s.jaw), "mirrored": s.is_mirrored}
        for s in chain.stretches
    ]
    return SplicedClip(name, person, motion, blended, mirrored, records)
