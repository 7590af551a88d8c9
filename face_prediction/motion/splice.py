"""Spliced motion: short stretches of one person joined to runs as long as an episode.

Most recordings of a person are shorter than an episode. A splice blends from the end of one stretch
into the beginning of another where the two are most alike; each sample records whether it was
blended and whether it is played backwards, so that nobody takes it for one recording.

Legend: T frames, B frames of a blend, W frames of the search for its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
        max_gap: Metres between two mouths that are blended, on average.
        max_spliced: Seconds of spliced motion of one person after which no stretch is added; by
            default so many that nobody makes up more than a fifth of the library that ships.
    """

    splice: bool = False
    mirror: bool = False
    blend: Positive = 0.4
    search: Positive = 0.3
    min_stretch: Positive = 1.25
    max_turn: Positive = 12.0
    max_gap: Positive = 0.03
    max_spliced: Positive = 72.0

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
        gap: m between the two mouths, likewise.
        cost: of differences in pose and velocity, see `best_join`.
    """

    leave: int
    enter: int
    turn: float
    gap: float
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
        stretches: clip, first frame, number of frames and direction of all that was joined, and
            by how much mouth and head differed, on average, where they were blended into.
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

    The cost of a place is the mean over the blend of the squared differences of mouth (in 5 mm),
    its velocity (in 0.05 m/s), head (in 5 degrees) and jaw (in 3 mm), each a small one that is
    seen.

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
    gap = np.linalg.norm(first.mouth[a] - second.mouth[b], axis=-1)
    leaving, entering = (np.gradient(s.mouth, axis=0) * fps for s in (first, second))
    speed = np.linalg.norm(leaving[a] - entering[b], axis=-1)
    jaw = first.jaw[a] - second.jaw[b]
    small = ((gap, 0.005), (speed, 0.05), (turn, 5.0), (jaw, 0.003))
    cost = np.mean(sum((value / unit) ** 2 for value, unit in small), axis=-1)
    place = np.unravel_index(int(np.argmin(cost)), cost.shape)
    return Join(
        leave=int(leaves[place[0]]),
        enter=int(enters[place[1]]),
        turn=float(turn.mean(axis=-1)[place]),
        gap=float(gap.mean(axis=-1)[place]),
        cost=float(cost[place]),
    )


class _Chain:
    """Stretches joined so far: mouth, orientation, jaw, and the two marks of each sample."""

    def __init__(self, first: Stretch, blend: int) -> None:
        self.blend, self.begin = blend, blend
        self.stretches: list[Stretch] = [first]
        self.joins: list[Join | None] = [None]
        self.parts = [*first.arrays, np.zeros(len(first.jaw), dtype=bool), first.marks]

    def __len__(self) -> int:
        return len(self.parts[0])

    def append(self, stretch: Stretch, join: Join) -> None:
        """Blend into another stretch."""
        blend, last = self.blend, self.stretches[-1]
        start = len(self) - len(last.jaw) + join.leave
        ahead = slice(join.enter, join.enter + blend + 1)
        old = [part[start : start + blend + 1] for part in self.parts]
        weight = smooth_step(np.arange(blend + 1) / blend)
        joined = [
            (1 - weight[:, None]) * old[0] + weight[:, None] * stretch.mouth[ahead],
            slerp(old[1], stretch.orientation[ahead], weight),
            (1 - weight) * old[2] + weight * stretch.jaw[ahead],
            (weight > 0) & (weight < 1),
            np.where(weight < 1, old[4], False) | np.where(weight > 0, stretch.marks[ahead], False),
        ]
        after = (*stretch.arrays, np.zeros_like(stretch.marks), stretch.marks)
        rest = [part[ahead.stop :] for part in after]
        parts = zip(self.parts, joined, rest, strict=True)
        self.parts = [np.concatenate([part[:start], new, end]) for part, new, end in parts]
        self.stretches.append(stretch)
        self.joins.append(join)
        self.begin = join.enter + 2 * blend  # between two blends, as much is as recorded


def join_stretches(given: Sequence[Stretch], settings: SpliceSettings, fps: float) -> list[_Chain]:
    """Join the stretches of one person, each once and, mirrored, once more.

    The first one begins; the one that fits best follows. A mirrored one follows where none
    forwards fits; where none fits at all, the next chain begins.
    """
    blend, search = max(round(settings.blend * fps), 1), round(settings.search * fps)
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
                    if join is not None
                    and join.turn <= settings.max_turn
                    and join.gap <= settings.max_gap
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
        # Takes have the person elsewhere before the camera: all are moved to the first one's place.
        middle = given[0].mouth.mean(axis=0)
        given = [replace(s, mouth=s.mouth - s.mouth.mean(axis=0) + middle) for s in given]
        fps = own[0][1].fps
        window = cuts.window(fps)
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
    window = cuts.window(fps)
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
    records: list[dict[str, Any]] = []
    for stretch, join in zip(chain.stretches, chain.joins, strict=True):
        record = {"clip": stretch.clip, "first": stretch.first, "frames": len(stretch.jaw)}
        record["mirrored"] = stretch.is_mirrored
        if join is not None:
            record |= {"gap_mm": round(1000 * join.gap, 1), "turn_degrees": round(join.turn, 1)}
        records.append(record)
    return SplicedClip(name, person, motion, blended, mirrored, records)
