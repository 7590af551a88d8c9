"""Synthetic face motions: nods, sway, tremor and others, each from a seed.

A motion is relative to the place where the face rests. Numbers without a source are choices of
this package. Legend: M frames, J columns, K sinusoids.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.face.motion import SEGMENT_DURATION, WORLD_FROM_CAMERA
from robo_manip_baselines.observation.corruption import FRAME_RATE
from robo_manip_baselines.runs.errors import RequestError, require_choice

Floats = NDArray[np.float64]
Span = tuple[float, float]
"""Range from which an episode draws one value uniformly; a single number stands for both ends."""

REACH = 0.09
"""m, largest displacement of the mouth on each axis. With the offset of the face, 0.05 m, the mouth
stays in a box of +-0.14 m that a level gripper reaches with 0.14 m of room in front."""

NECK_LEVER = np.array([0.0, -0.03, 0.10])
"""(3,) m, head frame (x the viewer's right, y up, z out of the face): centre of the lips from the
point about which the head turns. The neck of the modelled head lies 0.10 m behind its lips."""

LIPS_PER_JAW = np.array([-0.36, 0.0, -0.35])
"""(3,) world: displacement of the centre of the lips for each metre by which the jaw opens, the
head at rest. It is the mean of all lip landmarks, and the lower lip goes down and back."""


class Trajectory(NamedTuple):
    """Motion of a face, sampled.

    Attributes:
        displacement: (M, 3) m, world axes, of the centre of the lips.
        rotation: (M,) camera from head.
        jaw: (M,) m between the inner lips.
    """

    displacement: Floats
    rotation: Rotation
    jaw: Floats


class Limits(NamedTuple):
    """Limits of a parameter, or of both ends of a `Span`, and its unit."""

    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True)
class MotionPart:
    """Base of the motions: frozen dataclasses whose fields are annotated with `Limits`."""

    name: ClassVar[str]

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        for item in fields(self):
            (limits,) = hints[item.name].__metadata__
            value = self._checked(item.name, isinstance(item.default, tuple), limits)
            object.__setattr__(self, item.name, value)

    def _checked(self, name: str, is_span: bool, limits: Limits) -> float | Span:
        value, (low, high, unit) = getattr(self, name), limits
        ends = list(value) if is_span and isinstance(value, list | tuple) else [value]
        numbers = all(isinstance(e, int | float) and not isinstance(e, bool) for e in ends)
        if not (numbers and len(ends) in (1, 2) and low <= ends[0] <= ends[-1] <= high):
            kind = "a number, or two in ascending order, of" if is_span else "a number of"
            rule = f"must be {kind} {low:g} to {high:g} {unit}".rstrip()
            raise RequestError(f"motion '{self.name}', {name} {value}: {rule}")
        return (float(ends[0]), float(ends[-1])) if is_span else float(ends[0])

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> MotionPart:
        """Make a motion of its parameters by name.

        Raises:
            RequestError: there is no such parameter, or a value is not valid.
        """
        known = [item.name for item in fields(cls)]
        for name in values:
            if not known:
                raise RequestError(f"motion '{cls.name}' has no parameters; leave '{name}' out")
            require_choice(f"parameter of the motion '{cls.name}'", name, known)
        return cls(**values)

    def __str__(self) -> str:
        """Name, and the parameters that differ from the defaults: ``sway:amplitude=0.03``."""
        given = []
        for item in fields(self):
            value = getattr(self, item.name)
            if value != item.default:
                ends = dict.fromkeys(value if isinstance(value, tuple) else [value])
                given.append(f"{item.name}={'..'.join(f'{end:.10g}' for end in ends)}")
        return self.name + (":" if given else "") + ",".join(given)


@dataclass(frozen=True)
class SyntheticMotion(MotionPart):
    """Base of the motions that are computed.

    Attributes:
        frame_rate: samples per second that the motion needs; the replay interpolates linearly
            between them. A multiple of the recordings' 30.
    """

    frame_rate: ClassVar[float] = FRAME_RATE

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Draw a motion and return it at ``time`` (M,) s."""
        raise NotImplementedError


# -- signals --------------------------------------------------------------------------------------


def band_noise(rng: np.random.Generator, time: Floats, band: Span, columns: int) -> Floats:
    """Return noise (M, J) of a flat spectrum within ``band`` Hz and none outside, of rms near 1.

    It is a sum of sinusoids, one in each of 32 parts of the band, and never repeats itself.
    """
    parts = 32
    width = (band[1] - band[0]) / parts
    frequency = band[0] + width * (np.arange(parts) + rng.random((columns, parts)))
    phase = rng.uniform(0.0, 2.0 * np.pi, (columns, parts))
    waves = np.cos(2.0 * np.pi * frequency * time[:, None, None] + phase)  # (M, J, K)
    return waves.sum(axis=2) * math.sqrt(2.0 / parts)


def with_rms(signal: Floats, rms: float) -> Floats:
    """Scale a signal (M, J) so that the root mean square of its vectors is ``rms``."""
    return signal * (rms / math.sqrt(float((signal**2).sum(axis=1).mean())))


def least_jerk(time: Floats, start: float, duration: float) -> Floats:
    """Return a rise (M,) from 0 to 1 of least jerk (Flash and Hogan 1985)."""
    s = np.clip((time - start) / duration, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def event_times(
    rng: np.random.Generator, interval: Span, duration: Callable[[], float]
) -> list[tuple[float, float]]:
    """Return start and duration, s, of events until the end of a segment.

    The first starts within the longest interval, the others after a pause drawn from ``interval``.
    """
    events, start = [], rng.uniform(0.0, interval[1])
    while start < SEGMENT_DURATION:
        events.append((start, duration()))
        start += events[-1][1] + rng.uniform(*interval)
    return events


def turned(angles: Floats, jaw: Floats | None = None) -> Trajectory:
    """Return the motion of a head that turns about its neck.

    Args:
        angles: (M, 3) rad, rotation vectors in the camera frame: x nods the chin down, y turns to
            the viewer's right, z tilts to the viewer's left.
        jaw: (M,) m; closed if None.
    """
    rotation = Rotation.from_rotvec(angles)
    moved = (rotation.apply(NECK_LEVER) - NECK_LEVER) @ WORLD_FROM_CAMERA.T
    return Trajectory(moved, rotation, np.zeros(len(angles)) if jaw is None else jaw)


def shifted(displacement: Floats, angles: Floats | None = None) -> Trajectory:
    """Return the motion of a mouth along ``displacement`` (M, 3) m, with ``angles`` (M, 3) rad."""
    turn = np.zeros_like(displacement) if angles is None else angles
    return Trajectory(displacement, Rotation.from_rotvec(turn), np.zeros(len(displacement)))


def along(axis: int, angle: Floats) -> Floats:
    """Return rotation vectors (M, 3) about one axis of the camera frame."""
    vectors = np.zeros((len(angle), 3))
    vectors[:, axis] = angle
    return vectors


NOD, TURN = 0, 1
"""Axes of the camera frame about which a head nods and turns."""


# -- motions --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Still(SyntheticMotion):
    """No motion: a control, with which foresight cannot help."""

    name: ClassVar[str] = "still"

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return a face at rest."""
        return shifted(np.zeros((len(time), 3)))


@dataclass(frozen=True)
class Nod(SyntheticMotion):
    """Nods of one to three cycles, each smaller than the one before, with pauses between them.

    That cycles become smaller within a nod is from Mori et al. 2025 (PLOS ONE 20:e0323448, abstract
    read); the numbers are choices.

    Attributes:
        angle: deg, the chin's way down in the first cycle of a nod.
        frequency: Hz, cycles of a nod.
        pause: s, between nods.
        decline: size of a cycle relative to the one before.
    """

    name: ClassVar[str] = "nod"
    angle: Annotated[Span, Limits(0.0, 40.0, "deg")] = (5.0, 12.0)
    frequency: Annotated[Span, Limits(0.1, 4.0, "Hz")] = (0.8, 1.6)
    pause: Annotated[Span, Limits(0.0, 12.0, "s")] = (0.4, 2.0)
    decline: Annotated[float, Limits(0.0, 1.0)] = 0.7

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return nods about the neck."""
        frequency = rng.uniform(*self.frequency)
        cycles = event_times(rng, self.pause, lambda: float(rng.integers(1, 4)) / frequency)
        angle = np.zeros(len(time))
        for start, duration in cycles:
            passed = (time - start) * frequency
            size = rng.uniform(*self.angle) * self.decline ** np.floor(passed)
            inside = (time >= start) & (time < start + duration)
            angle += np.where(inside, size * (1.0 - np.cos(2.0 * np.pi * passed)) / 2.0, 0.0)
        return turned(along(NOD, np.radians(angle)))


@dataclass(frozen=True)
class Turn(SyntheticMotion):
    """Looks to one side and the other, with rests between them.

    The numbers are choices; recorded heads turn by up to 33 deg and 288 deg/s.

    Attributes:
        angle: deg, from the front, to either side.
        duration: s, of a turn.
        rest: s, between turns.
    """

    name: ClassVar[str] = "turn"
    angle: Annotated[Span, Limits(0.0, 45.0, "deg")] = (5.0, 20.0)
    duration: Annotated[Span, Limits(0.1, 12.0, "s")] = (0.6, 1.2)
    rest: Annotated[Span, Limits(0.0, 12.0, "s")] = (0.3, 1.5)

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return turns about the neck."""
        side = rng.choice([-1.0, 1.0])
        angle, last = np.zeros(len(time)), 0.0
        for start, duration in event_times(rng, self.rest, lambda: rng.uniform(*self.duration)):
            goal = side * rng.uniform(*self.angle)
            angle += (goal - last) * least_jerk(time, start, duration)
            side, last = -side, goal
        return turned(along(TURN, np.radians(angle)))


@dataclass(frozen=True)
class Sway(SyntheticMotion):
    """Sway of the trunk from side to side, the head kept upright.

    The numbers are those of the study that this motion was introduced for.

    Attributes:
        frequency: Hz.
        amplitude: m, half of the way from one end to the other.
        direction: deg, from side to side, to which it is turned at most, to either side.
    """

    name: ClassVar[str] = "sway"
    frequency: Annotated[Span, Limits(0.01, 3.0, "Hz")] = (0.25, 0.6)
    amplitude: Annotated[Span, Limits(0.0, REACH, "m")] = (0.020, 0.035)
    direction: Annotated[float, Limits(0.0, 90.0, "deg")] = 30.0

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return one sinusoid."""
        frequency, amplitude = rng.uniform(*self.frequency), rng.uniform(*self.amplitude)
        phase = rng.uniform(0.0, 2.0 * np.pi)
        bearing = math.radians(rng.uniform(-self.direction, self.direction))
        way = np.array([math.sin(bearing), math.cos(bearing), 0.0])
        wave = amplitude * np.sin(2.0 * np.pi * frequency * time + phase)
        return shifted(wave[:, None] * way)


TREMOR_SLOPE, TREMOR_OFFSET = 0.47, -1.8
"""Of log10(T / cm) = slope rating + offset, T the displacement of a head (Elble et al. 2016)."""

TREMOR_DIRECTIONS = (14, 9, 28)
"""Patients, of 51, whose head says "no-no", "yes-yes" or both (Robakis and Louis 2015)."""


def tremor_displacement(rating: float) -> float:
    """Return the displacement, m from end to end, of a head tremor of clinical rating 0 ... 4."""
    return 0.01 * 10.0 ** (TREMOR_SLOPE * rating + TREMOR_OFFSET)


@dataclass(frozen=True)
class Tremor(SyntheticMotion):
    """Tremor of the head, turned, nodded or both: a control, too fast for an arm to follow.

    *Amplitude.* Elble et al. 2006 (Brain 129:2660) found log10 T = alpha rating + beta for the
    tremor T, in cm, of hands, with alpha 0.27 to 0.58. For heads, Elble et al. 2016 (Mov Disord
    Clin Pract 4:205, PMC6174406) give alpha 0.47, beta -1.8 for the displacement at the vertex, and
    0.64 and -1.4 for the rotation. These numbers, and the unit of hands, are in the abstracts. Not
    verified, since only the abstracts could be read: that T of heads is in cm (and deg), and that
    it is measured from end to end, as assumed here. The two relations support the units: with a
    lever of 0.10 m, a rotation in deg gives 0.3, 1.3 and 5.8 mm at ratings 1, 2 and 3, a
    displacement in cm 0.5, 1.4 and 4.1 mm.

    *Direction.* Of 51 patients with essential tremor of the head, 14 turned it, 9 nodded and 28 did
    both (Robakis and Louis 2015, PMC4695227, abstract). Both at once are equal parts here.

    Attributes:
        rating: clinical rating, 0 (none) to 4 (severe).
        frequency: Hz; essential tremor is at 4 to 12, of heads mostly near 5.
    """

    name: ClassVar[str] = "tremor"
    frame_rate: ClassVar[float] = 5 * FRAME_RATE  # lines between 30 frames/s would clip its peaks
    rating: Annotated[float, Limits(0.0, 4.0)] = 2.0
    frequency: Annotated[Span, Limits(1.0, 15.0, "Hz")] = (4.0, 11.0)

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return an oscillation whose phase and strength wander a little."""
        frequency = rng.uniform(*self.frequency)
        kind = rng.choice(3, p=np.array(TREMOR_DIRECTIONS) / sum(TREMOR_DIRECTIONS))
        weights = np.array([kind != 0, kind != 1, 0.0])
        drift = band_noise(rng, time, (0.05, 0.5), 2)
        phase = rng.uniform(0.0, 2.0 * np.pi, 3) + 0.5 * drift[:, :1]
        strength = np.maximum(1.0 + 0.2 * drift[:, 1:], 0.0)
        angles = weights * strength * np.sin(2.0 * np.pi * frequency * time[:, None] + phase)
        # A sine from end to end has 2 sqrt(2) times its rms; the mouth is a lever from the neck.
        wanted = tremor_displacement(self.rating) / (2.0 * math.sqrt(2.0))
        angles = with_rms(angles, wanted / float(np.linalg.norm(NECK_LEVER)))
        moved = turned(angles).displacement
        return turned(angles * wanted / math.sqrt(float((moved**2).sum(axis=1).mean())))


@dataclass(frozen=True)
class Dyskinetic(SyntheticMotion):
    """Involuntary, aimless motion in all directions, as of dyskinesia: noise within a band.

    Its rms over an episode is exact. The numbers are those of the study that this motion was
    introduced for; the rotation is a choice.

    Attributes:
        rms: m, of the displacement, all axes together.
        band: Hz.
        rotation: deg, rms about all axes together.
    """

    name: ClassVar[str] = "dyskinetic"
    rms: Annotated[float, Limits(0.0, 0.03, "m")] = 0.015
    band: Annotated[Span, Limits(0.01, 5.0, "Hz")] = (0.2, 1.5)
    rotation: Annotated[float, Limits(0.0, 15.0, "deg")] = 3.0

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return noise in six dimensions."""
        noise = band_noise(rng, time, self.band, 6)
        angles = with_rms(noise[:, 3:], math.radians(self.rotation))
        return shifted(with_rms(noise[:, :3], self.rms), angles)


@dataclass(frozen=True)
class Spasm(SyntheticMotion):
    """Rare, sudden jerks to one place, with a slow return. The numbers are choices.

    Attributes:
        amplitude: m, of a jerk, in any direction.
        angle: deg, by which the head turns, about any axis.
        rise: s, of the jerk.
        back: s, of the return.
        interval: s, from the end of one to the next.
    """

    name: ClassVar[str] = "spasm"
    amplitude: Annotated[Span, Limits(0.0, REACH, "m")] = (0.02, 0.04)
    angle: Annotated[Span, Limits(0.0, 30.0, "deg")] = (3.0, 10.0)
    rise: Annotated[float, Limits(0.05, 2.0, "s")] = 0.15
    back: Annotated[float, Limits(0.1, 12.0, "s")] = 1.5
    interval: Annotated[Span, Limits(0.0, 12.0, "s")] = (2.0, 6.0)

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return jerks."""
        displacement, angles = np.zeros((2, len(time), 3))
        for start, _ in event_times(rng, self.interval, lambda: self.rise + self.back):
            there = least_jerk(time, start, self.rise)
            gone = there - least_jerk(time, start + self.rise, self.back)
            way, axis = rng.standard_normal((2, 3))
            size, turn = rng.uniform(*self.amplitude), math.radians(rng.uniform(*self.angle))
            displacement += gone[:, None] * size * way / np.linalg.norm(way)
            angles += gone[:, None] * turn * axis / np.linalg.norm(axis)
        return shifted(displacement, angles)


@dataclass(frozen=True)
class TurnAway(SyntheticMotion):
    """Refusal: the head turns far away, stays there, and comes back. The numbers are choices.

    A head that is turned by more than 35 deg cannot be fed, see the limits of recorded motion.

    Attributes:
        angle: deg, to either side.
        duration: s, of the way there, and of the way back.
        stay: s, turned away.
        interval: s, from coming back to the next refusal.
    """

    name: ClassVar[str] = "turn_away"
    angle: Annotated[Span, Limits(0.0, 60.0, "deg")] = (35.0, 45.0)
    duration: Annotated[Span, Limits(0.2, 6.0, "s")] = (0.5, 0.9)
    stay: Annotated[Span, Limits(0.0, 12.0, "s")] = (1.0, 2.0)
    interval: Annotated[Span, Limits(0.0, 12.0, "s")] = (3.0, 6.0)

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return refusals, each to one side."""
        ways = (self.duration, self.stay, self.duration)
        angle, drawn = np.zeros(len(time)), [[0.0, 0.0, 0.0]]

        def duration() -> float:
            drawn.append([rng.uniform(*span) for span in ways])
            return sum(drawn[-1])

        for start, _ in event_times(rng, self.interval, duration):
            leave, stay, back = drawn.pop(1)
            gone = least_jerk(time, start, leave) - least_jerk(time, start + leave + stay, back)
            angle += gone * rng.choice([-1.0, 1.0]) * rng.uniform(*self.angle)
        return turned(along(TURN, np.radians(angle)))


@dataclass(frozen=True)
class Chew(SyntheticMotion):
    """Chewing: the jaw opens and closes, and the head gives a little.

    Between 50 and 100 cycles a minute is slow and fast chewing in Throckmorton et al. 2001 (J Oral
    Rehabil 28:328, abstract). The opening, which is added to that of a person who waits to be fed,
    and the nod are choices.

    Attributes:
        frequency: Hz.
        opening: m, by which the lips part.
        nod: deg, by which the head goes back as the jaw opens.
    """

    name: ClassVar[str] = "chew"
    frequency: Annotated[Span, Limits(0.1, 4.0, "Hz")] = (0.83, 1.67)
    opening: Annotated[Span, Limits(0.0, 0.025, "m")] = (0.008, 0.015)
    nod: Annotated[float, Limits(0.0, 10.0, "deg")] = 1.0

    def sample(self, rng: np.random.Generator, time: Floats) -> Trajectory:
        """Return cycles of the jaw."""
        frequency, opening = rng.uniform(*self.frequency), rng.uniform(*self.opening)
        phase = 2.0 * np.pi * frequency * time + rng.uniform(0.0, 2.0 * np.pi)
        share = (1.0 - np.cos(phase)) / 2.0
        head = turned(along(NOD, -np.radians(self.nod) * share), jaw=opening * share)
        return head._replace(displacement=head.displacement + head.jaw[:, None] * LIPS_PER_JAW)
