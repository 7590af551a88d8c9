"""Face motions by name: recorded, synthetic, and sums of them.

A motion is written ``sway``, with parameters ``sway:amplitude=0.03``, with a range from which every
episode draws ``sway:amplitude=0.02..0.03``, and as a sum ``recorded:speed=2+tremor:rating=3``. In
YAML and in arguments of an environment it may be a mapping, ``{name: sway, amplitude: 0.03}``, or a
list of motions, the parts of a sum.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.face.motion import (
    SEGMENT_DURATION,
    WORLD_FROM_CAMERA,
    MotionLibrary,
    MotionSegment,
)
from robo_manip_baselines.envs.mujoco.face.synthetic import (
    REACH,
    Chew,
    Dyskinetic,
    Limits,
    MotionPart,
    Nod,
    Spasm,
    Still,
    Sway,
    SyntheticMotion,
    Trajectory,
    Tremor,
    Turn,
    TurnAway,
)
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.seeds import stream_generator

SYNTHETIC = "synthetic"
"""Clip and person of a motion without a recording."""

LOOKAHEAD = 1.0
"""s of a synthetic motion after the end of an episode, for the truth about its future."""

TURNING_POINT = 1.0
"""s from the end of a run within which a replay that is too fast for it turns round."""

_ATTEMPTS = 50
"""Draws of a motion, of which the first that stays within reach is taken."""


@dataclass(frozen=True)
class Recorded(MotionPart):
    """Motion of a recorded person, see `MotionLibrary`.

    Faster than it was, the same recording is replayed from the same start: 12 s of an episode take
    12 s x speed of it. A run that ends before is replayed there and back, turning where its mouth
    is slowest in its last (or first) second. Forecasts of a trained predictor belong to the
    original speed; a faster replay comes without them.

    Attributes:
        speed: relative to the recording.
    """

    name: ClassVar[str] = "recorded"
    speed: Annotated[float, Limits(1.0, 4.0)] = 1.0

    def draw(
        self, rng: np.random.Generator, library: MotionLibrary, clips: Sequence[str] | None
    ) -> MotionSegment:
        """Draw a start, the same at every speed.

        Raises:
            RequestError: no such clip, or no run is long enough.
        """
        segment = library.draw(rng, clips=clips)
        return segment if self.speed == 1.0 else replay_faster(library, segment, self.speed)


def replay_faster(library: MotionLibrary, segment: MotionSegment, speed: float) -> MotionSegment:
    """Return the replay of a segment and of what follows it, see `Recorded`."""
    ends = library.run_start + library.run_length
    run = np.flatnonzero((library.run_start <= segment.index) & (segment.index < ends))[0]
    part = slice(int(library.run_start[run]), int(ends[run]))
    mouth = library.mouth[part] - library.mouth[segment.index]
    whole = replace(
        segment,
        displacement=mouth @ WORLD_FROM_CAMERA.T,
        orientation=library.orientation[part],
        jaw=library.jaw[part],
        predicted=None,
    )
    step = np.linalg.norm(np.diff(mouth, axis=0), axis=1)
    margin = round(TURNING_POINT * library.fps)
    low, high = int(np.argmin(step[:margin])), len(step) - int(np.argmin(step[: -margin - 1 : -1]))
    frames = segment.start + speed * np.arange(_frame_count(library.fps), dtype=np.float64)
    displacement, orientation, jaw = whole.at(there_and_back(frames, low, high) / library.fps)
    return replace(whole, displacement=displacement, orientation=orientation, jaw=jaw)


def there_and_back(frames: NDArray[np.float64], low: int, high: int) -> NDArray[np.float64]:
    """Fold ascending frame numbers (M,) into low ... high; those before ``low`` stay."""
    beyond = np.maximum(frames - low, 0.0) % (2 * (high - low))
    folded = low + np.minimum(beyond, 2 * (high - low) - beyond)
    return np.where(frames < low, frames, folded)


MOTIONS: Mapping[str, type[MotionPart]] = {
    motion.name: motion
    for motion in (
        Recorded,
        Still,
        Nod,
        Turn,
        Sway,
        Tremor,
        Dyskinetic,
        Spasm,
        TurnAway,
        Chew,
    )
}
"""Name of a motion -> its class."""


@dataclass(frozen=True)
class FaceMotion:
    """Motion of the face in the episodes of an environment: one motion, or the sum of several.

    Displacements and jaw openings add up; rotations multiply, the first part being outermost.

    Attributes:
        parts: at most one of them recorded.

    Raises:
        RequestError: more than one part is recorded.
    """

    parts: tuple[MotionPart, ...]

    def __post_init__(self) -> None:
        names = [part.name for part in self.parts]
        if twice := [name for name in names if names.count(name) > 1]:
            raise RequestError(f"motion '{self}': '{twice[0]}' is there twice; leave one out")

    def __str__(self) -> str:
        """Text from which `parse_motion` makes the same motion."""
        return "+".join(str(part) for part in self.parts)

    @property
    def recorded(self) -> Recorded | None:
        """Recorded part, if there is one."""
        return next((part for part in self.parts if isinstance(part, Recorded)), None)

    @property
    def refuses(self) -> bool:
        """True if the head turns away to refuse, now and then."""
        return any(isinstance(part, TurnAway) for part in self.parts)

    @property
    def is_as_recorded(self) -> bool:
        """True for a recorded motion unchanged, to which a predictor's forecasts apply."""
        return self.parts == (Recorded(),)

    def draw(
        self,
        rng: np.random.Generator,
        library: MotionLibrary,
        *,
        seed: int | None = None,
        clips: Sequence[str] | None = None,
        people: str = "all",
    ) -> MotionSegment:
        """Draw the motion of an episode.

        Args:
            rng: draws the start of a recording; synthetic motions take one number from it, too, so
                that what is drawn from it later does not depend on the motion.
            library: recorded motion.
            seed: of the episode, for the named streams of synthetic motions; drawn if None.
            clips: ids of the clips to draw from; all if None.
            people: whose motion: ``all``, ``train`` or ``test``. Of recordings, see
                `MotionLibrary.part`; a synthetic motion is another person with every seed, and the
                seeds of each kind of people have streams of their own.

        Raises:
            RequestError: no such clip, no run is long enough, the library cannot be split, or the
                motion leaves the reach of the arm.
        """
        if self.recorded is not None:
            library = library.part(people)
        if self.is_as_recorded:
            return library.draw(rng, clips=clips)
        if seed is None:
            seed = int(rng.integers(2**32))
        if self.recorded is None:
            rng.integers(2**32)
        for attempt in range(_ATTEMPTS):
            recording = None
            if self.recorded is not None:
                again = stream_generator(seed, "face motion recorded", attempt)
                recording = self.recorded.draw(again if attempt else rng, library, clips)
            segment = self._combine(recording, seed, attempt, people)
            if np.abs(segment.displacement).max() <= REACH:
                return segment
        raise RequestError(
            f"motion '{self}': in {_ATTEMPTS} draws the mouth always left the reach of the arm, "
            f"{REACH:g} m from its place on an axis; choose smaller amplitudes or fewer parts"
        )

    def _combine(
        self, recording: MotionSegment | None, seed: int, attempt: int, people: str
    ) -> MotionSegment:
        """Sum up the recording and the synthetic parts."""
        computed = [part for part in self.parts if isinstance(part, SyntheticMotion)]
        if recording is not None and not computed:
            return recording
        rates = [part.frame_rate for part in computed]
        fps = max(rates) if recording is None else max(*rates, recording.fps)
        time = np.arange(_frame_count(fps)) / fps
        displacement, rotation, jaw = np.zeros((len(time), 3)), Rotation.identity(), 0.0
        whose = "" if people == "all" else f" of {people}"
        for part in self.parts:
            if isinstance(part, SyntheticMotion):
                rng = stream_generator(seed, f"face motion {part.name}{whose}", attempt)
                moved = part.sample(rng, time)
            else:
                assert recording is not None
                replayed, turn, opened = recording.at(time)
                moved = Trajectory(replayed, Rotation.from_quat(turn, scalar_first=True), opened)
            displacement, jaw = displacement + moved.displacement, jaw + moved.jaw
            rotation = rotation * moved.rotation
        return MotionSegment(
            fps=fps,
            displacement=displacement,
            orientation=rotation.as_quat(scalar_first=True, canonical=True),
            jaw=np.asarray(jaw),
            clip=SYNTHETIC if recording is None else recording.clip,
            subject=SYNTHETIC if recording is None else recording.subject,
            start=0 if recording is None else recording.start,
            index=-1 if recording is None else recording.index,
        )


def parse_motion(given: Any) -> FaceMotion:
    """Make a motion of text, a mapping, or a list of them; see the module.

    Raises:
        RequestError: no such motion or parameter, or a value is not valid.
    """
    if isinstance(given, FaceMotion):
        return given
    if isinstance(given, str):
        return FaceMotion(tuple(_parse_text(part) for part in re.split(r"\+(?=\D)", given)))
    if isinstance(given, Mapping):
        return FaceMotion((_parse_mapping(given),))
    if isinstance(given, Sequence) and given:
        return FaceMotion(tuple(part for item in given for part in parse_motion(item).parts))
    example = "such as sway, {name: sway, amplitude: 0.03} or [recorded, tremor]"
    raise RequestError(f"motion {given!r}: must be a name, a mapping or a list, {example}")


def _parse_mapping(given: Mapping[Any, Any]) -> MotionPart:
    values = {str(key): value for key, value in given.items()}
    if "name" not in values:
        raise RequestError(f"motion {given}: has no name; valid: {', '.join(MOTIONS)}")
    name = require_choice("motion", str(values.pop("name")), MOTIONS)
    return MOTIONS[name].from_values(values)


def _parse_text(text: str) -> MotionPart:
    name, _, settings = text.strip().partition(":")
    values: dict[str, Any] = {"name": name.strip()}
    for setting in settings.split(",") if settings else ():
        key, sign, value = (item.strip() for item in setting.partition("="))
        try:
            numbers = [float(end) for end in value.split("..")]
        except ValueError:
            numbers = []
        if not (sign and numbers) or key in values:
            raise RequestError(
                f"motion '{text}': '{setting}' is no setting; write it as in "
                "sway:amplitude=0.03,frequency=0.3..0.5"
            )
        values[key] = numbers[0] if len(numbers) == 1 else numbers
    return _parse_mapping(values)


def _frame_count(fps: float) -> int:
    """Frames of a segment: an episode and what follows it."""
    return round((SEGMENT_DURATION + LOOKAHEAD) * fps) + 1
