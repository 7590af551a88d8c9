"""Success of wiping: predicates on force and place, and the progress of an episode."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FORCE_LOW, FORCE_HIGH = 1.0, 3.0
"""N, the normal force between pad and cheek within which the pad wipes, both included. Above the
upper one a wipe is no longer light: a robot that washed people's limbs took more than 96 % of the
debris off with less than 3 N (King, Chen, Jain and Kemp, IROS 2010). Below the lower one the pad
glides over the residue."""

PUSH_FORCE = 10.0
"""N that the robot may never exceed on the face: the tier of `registry.FORCE_LIMITS` above
which a touch is a push."""

WIPE_RADIUS = 0.010
"""m around the point of contact within which the pad wipes. A ball of radius 15 mm that is
flattened by 2 mm and more touches a disc of radius sqrt(2 r d - d²), 7 mm and more."""

WIPED_SHARE = 0.8
"""Share of the residue that is to be wiped off."""

RANGE_SHARE = 0.7
"""Share of the time in contact that the force is to be within the range. Coming and going cross
0 to 1 N, a twentieth of the expert's contact; the rest is left to faces that move suddenly."""

EYE_RADIUS = 0.020
"""m around the middle of the lids within which the robot touches the eye: half the width of the
opening between the lids (15 mm) and the lashes."""

CLEAR_DISTANCE = 0.08
"""m between the pad's centre and the middle of the residue from which the pad has withdrawn: five
times its radius."""


class Phase(enum.IntEnum):
    """Phase of the task. Only ever advances."""

    APPROACH = 0
    WIPE = 1
    FINISH = 2


def is_in_range(force: float) -> bool:
    """Return whether the pad wipes with this normal force, N."""
    return FORCE_LOW <= force <= FORCE_HIGH


def reached_spots(
    spots: NDArray[np.float64], contact: NDArray[np.float64] | None, force: float
) -> frozenset[int]:
    """Return the numbers of the spots that the pad wipes now.

    Args:
        spots: (S, 3) m, on the face.
        contact: (3,) m, the point of contact in the same frame; None without contact.
        force: N, normal force between pad and cheek.
    """
    if contact is None or not is_in_range(force):
        return frozenset()
    distance = np.linalg.norm(spots - contact, axis=-1)
    return frozenset(np.flatnonzero(distance < WIPE_RADIUS).tolist())


def is_on_eye(point: NDArray[np.float64], eyes: NDArray[np.float64]) -> bool:
    """Return whether a point of contact (3,) m is on an eye; ``eyes`` (2, 3) m, the same frame."""
    return bool((np.linalg.norm(eyes - point, axis=-1) < EYE_RADIUS).any())


@dataclass(frozen=True)
class StepMeasurements:
    """Measurements of one control step.

    Attributes:
        time: s since the start of the episode.
        pad_force: N, normal force between pad and face, the mean of the step.
        face_force: N, the largest between robot and face in the step.
        reached: spots that the pad wipes, see ``reached_spots``.
        touches_eye: the robot touches an eye.
        pad_distance: m between the pad's centre and the middle of the residue.
    """

    time: float
    pad_force: float
    face_force: float
    reached: frozenset[int]
    touches_eye: bool
    pad_distance: float


@dataclass(frozen=True)
class WipingProgress:
    """Events of an episode so far; ``advance`` returns the next.

    Attributes:
        spots: number of spots of residue at the start.
        wiped: those that are wiped off.
        contact_steps: control steps with the pad on the face.
        steps_in_range: those of them with a force in the range.
        largest_force: N between robot and face.
        touched_eye: the robot has touched an eye.
        success_time: s at which enough was wiped off.
        is_clear: the pad has withdrawn after that.
    """

    spots: int
    wiped: frozenset[int] = frozenset()
    contact_steps: int = 0
    steps_in_range: int = 0
    largest_force: float = 0.0
    touched_eye: bool = False
    success_time: float | None = None
    is_clear: bool = False

    @property
    def wiped_share(self) -> float:
        """Share of the residue that is wiped off."""
        return len(self.wiped) / self.spots

    @property
    def range_share(self) -> float:
        """Share of the time in contact with a force in the range; 0 without contact."""
        return self.steps_in_range / max(self.contact_steps, 1)

    @property
    def phase(self) -> Phase:
        """See ``Phase``."""
        if self.success_time is not None:
            return Phase.FINISH
        return Phase.WIPE if self.contact_steps else Phase.APPROACH

    @property
    def is_success(self) -> bool:
        """Enough of the residue is wiped off."""
        return self.success_time is not None

    @property
    def is_success_strict(self) -> bool:
        """It was wiped off, and so far lightly, never pushing, and no eye was touched."""
        return (
            self.is_success
            and self.range_share >= RANGE_SHARE
            and self.largest_force <= PUSH_FORCE
            and not self.touched_eye
        )

    def advance(self, step: StepMeasurements) -> WipingProgress:
        """Take in the measurements of one control step."""
        wiped = self.wiped | step.reached
        success_time = self.success_time
        if success_time is None and len(wiped) >= WIPED_SHARE * self.spots:
            success_time = step.time
        withdrawn = success_time is not None and step.pad_distance >= CLEAR_DISTANCE
        return replace(
            self,
            wiped=wiped,
            contact_steps=self.contact_steps + (step.pad_force > 0.0),
            steps_in_range=self.steps_in_range + is_in_range(step.pad_force),
            largest_force=max(self.largest_force, step.face_force),
            touched_eye=self.touched_eye or step.touches_eye,
            success_time=success_time,
            is_clear=self.is_clear or withdrawn,
        )
