"""Success of feeding: predicates on geometry, and the progress of an episode."""

from __future__ import annotations

import enum
import operator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.lift import LiftProgress

MOUTH_TOLERANCE = np.array([0.03, 0.01, 0.01])
"""m along world x (the face normal), y and z; the spatial condition of Algorithm 1, line 10."""

_TOLERANCES = MOUTH_TOLERANCE.tolist()

FACE_FORCE = {"gripper": 0.0, "spoon": 10.0}
"""N between robot and face beyond which strict success is lost: none for a gripper, which has
nothing to do at a face; for a spoon, which rests on lips, that of `safety.SAFE_FORCE`."""

LIFT_HEIGHT = 0.10
"""m of the cube's centre above the table from which it counts as lifted: clear of the table by
twice its size, and low enough that the way to the mouth still lies ahead."""

CLEAR_DISTANCE = 0.12
"""m between gripper and mouth from which the gripper has withdrawn: three cube sizes."""


class Phase(enum.IntEnum):
    """Phase of the task. Only ever advances, except back to REACH before the lift."""

    REACH = 0
    GRASP = 1
    CARRY = 2
    DELIVER = 3
    RELEASE = 4


def is_at_mouth(gripper: NDArray[np.float64], mouth: NDArray[np.float64]) -> bool:
    """Algorithm 1's spatial condition on two points, (3,) m, in the world frame.

    The first one is the gripper, or the middle of a spoon's bowl. They are within 0.03, 0.01 and
    0.01 m of one another, the bounds excluded.
    """
    distances = np.abs(gripper - mouth).tolist()  # Python's floats are faster one by one
    return all(map(operator.lt, distances, _TOLERANCES))


@dataclass(frozen=True)
class StepMeasurements:
    """Measurements of one control step.

    Attributes:
        time: s since the start of the episode.
        is_held: both fingers touch the cube; or the food is on the spoon.
        is_touched: any finger touches the cube; or the food is on the spoon.
        cube_height: m of the cube's centre above the table.
        is_at_mouth: see the predicate of that name.
        is_inside_mouth: the centre of the cube is, see `mouth.is_inside_mouth`.
        touches_face: the robot presses lips or face with more than `FACE_FORCE`.
        gripper_distance: m between gripper, or spoon, and mouth.
    """

    time: float
    is_held: bool
    is_touched: bool
    cube_height: float
    is_at_mouth: bool
    is_inside_mouth: bool
    touches_face: bool
    gripper_distance: float


@dataclass(frozen=True)
class FeedingProgress(LiftProgress):
    """Events of an episode so far; ``advance`` returns the next.

    Attributes:
        phase: see ``Phase``.
        lift_time: s at which the cube was lifted.
        success_time: s at which Algorithm 1's condition was first met with the cube held.
        release_time: s at which the fingers let go of the lifted cube.
        touched_face: the gripper has touched lips or face since the lift.
        released_inside: the cube was in the mouth when it was let go.
        is_clear: the gripper has withdrawn after the release.
    """

    phase: Phase = Phase.REACH
    release_time: float | None = None
    touched_face: bool = False
    released_inside: bool = False
    is_clear: bool = False

    @property
    def is_success_strict(self) -> bool:
        """The cube was let go inside the mouth opening and the gripper never touched the face."""
        return self.is_success and self.released_inside and not self.touched_face

    def advance(self, step: StepMeasurements) -> FeedingProgress:
        """Take in the measurements of one control step."""
        lift_time = self.lift_time
        if lift_time is None and step.is_held and step.cube_height >= LIFT_HEIGHT:
            lift_time = step.time
        lifted = lift_time is not None
        success_time = self.success_time
        if success_time is None and lifted and step.is_held and step.is_at_mouth:
            success_time = step.time
        release_time, released_inside = self.release_time, self.released_inside
        if release_time is None and lifted and not step.is_touched:
            release_time, released_inside = step.time, step.is_inside_mouth
        released = release_time is not None
        if released:
            phase = Phase.RELEASE
        elif lifted:
            phase = Phase.CARRY if success_time is None else Phase.DELIVER
        else:
            phase = Phase.GRASP if step.is_held else Phase.REACH
        return FeedingProgress(
            phase=phase,
            lift_time=lift_time,
            success_time=success_time,
            release_time=release_time,
            touched_face=self.touched_face or (lifted and step.touches_face),
            released_inside=released_inside,
            is_clear=self.is_clear or (released and step.gripper_distance >= CLEAR_DISTANCE),
        )
