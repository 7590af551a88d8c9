"""Scripted experts of bimanual feeding: the left arm fetches and passes, the right one feeds."""

from __future__ import annotations

from dataclasses import replace

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.expert.phases import (
    Command,
    ExpertPhase,
    ExpertView,
    Grip,
    PhasedExpert,
    Reach,
    Wait,
    level_at,
)
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.env import (
    LEFT_HOME_QPOS,
    BimanualFeedingEnv,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import (
    GRASP_OFFSET,
    FeedingExpert,
    FeedingServo,
    bring,
    pick_up,
)

MEETING = np.array([-0.19, 0.12, 0.27])
"""m, world: where the cube is handed over, beside the person and above the right shoulder. Lower or
nearer, the right gripper, 0.15 m across, brushes the shoulder of a person who leans towards it;
further away, the left wrist reaches its limit."""

HOLD_DEPTH = 0.02
"""m from the site of the left gripper, which points down, to the cube's centre: its fingers hold
the upper half of the cube, so that those of the right one find room below and between them."""

BEFORE = 0.20
"""m from where the right gripper takes the cube to where it waits for it, backwards."""

RISE = 0.04
"""m by which the left gripper goes up once it has let go: its finger tips are then 0.03 m above the
right one's fingers."""

RETREAT = np.array([0.0, 0.0, 0.05])
"""m, world, by which the right gripper rises as it goes back from the meeting place."""

RETREAT_LENGTH = 0.20
"""m by which it goes back there, away from the person's side."""

APPROACH_LIMIT = 5.0
"""s after the hand-over within which the right gripper should be at the mouth; Algorithm 1 has 6 s
after the lift, most of which it takes: an episode leaves less after a hand-over."""


def reactive(env: BimanualFeedingEnv) -> BimanualExpert:
    """Make the expert whose right arm feeds by Algorithm 1."""
    return BimanualExpert(env, FeedingExpert(env, limit=APPROACH_LIMIT))


def servo(env: BimanualFeedingEnv) -> BimanualExpert:
    """Make the expert whose right arm is a visual servo that aims by its own lag ahead."""
    return BimanualExpert(env, FeedingServo(env))


def downwards(yaw: float) -> mink.SO3:
    """Return the orientation of a gripper that points down and closes along ``yaw`` + 90 degrees.

    ``yaw`` is in rad about world z, from world x.
    """
    return mink.SO3.from_z_radians(yaw) @ mink.SO3.from_y_radians(np.pi / 2)


def along(orientation: mink.SO3) -> NDArray[np.float64]:
    """Return where a gripper points, (3,), world."""
    return orientation.as_matrix()[:, 0]


TAKING = level_at(MEETING)
"""Orientation of the right gripper when it takes the cube."""

PASSING = downwards(float(np.arctan2(*along(TAKING)[1::-1])) + np.pi / 2)
"""Orientation of the left gripper meanwhile: it closes along the direction in which the right one
points, so that each of them holds the sides of the cube that the other leaves free."""

FETCHING = downwards(-np.pi / 2)
"""Orientation of the left gripper at the table: it closes along world x."""


class LeftHand(PhasedExpert):
    """Expert of the left arm: fetch the cube, hold it out, let go of it, and go home.

    Args:
        env: the environment, unwrapped.
    """

    def __init__(self, env: BimanualFeedingEnv) -> None:
        super().__init__("left", LEFT_HOME_QPOS)
        self._env = env
        self.taker: PhasedExpert = self

    def view(self) -> ExpertView:
        """Return the present state."""
        return ExpertView(self._env.mouth_track, self._env.cube_position)

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""
        up = np.array([0.0, 0.0, 1.0])

        def held_out(view: ExpertView, last: Command) -> Command:
            return Command(MEETING + HOLD_DEPTH * up, PASSING, last.finger)

        def risen(view: ExpertView, last: Command) -> Command:
            return replace(last, position=last.position + RISE * up)

        return [
            *pick_up(FETCHING, HOLD_DEPTH),
            Reach(held_out, speed=0.30),
            Wait(lambda: self.taker.phases_done >= TAKEN),
            Grip(FINGER_OPEN, 0.3),
            Reach(risen),
            Reach(lambda view, last: home),
        ]


HELD_OUT, LET_GO = 5, 8
"""Phases of a `LeftHand` that are done when it holds the cube out, and when it has let go of it."""


class RightHand(PhasedExpert):
    """Expert of the right arm: take the cube from the left one, and feed.

    Args:
        env: the environment, unwrapped.
        feeder: feeds once the cube has been taken.
    """

    def __init__(self, env: BimanualFeedingEnv, feeder: FeedingExpert) -> None:
        super().__init__("right", HOME_QPOS)
        self._env, self._feeder = env, feeder
        self.giver: PhasedExpert = self

    def view(self) -> ExpertView:
        """Return the present state; the approach may begin with the hand-over."""
        env, start = self._env, self._env.handover.time
        elapsed = None if start is None else env.time - start
        return replace(self._feeder.view(), elapsed=elapsed)

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""
        ahead = along(TAKING)

        def ready(view: ExpertView, last: Command) -> Command:
            return Command(MEETING - (GRASP_OFFSET + BEFORE) * ahead, TAKING, FINGER_OPEN)

        def at_cube(view: ExpertView, last: Command) -> Command:
            return replace(last, position=view.object_position - GRASP_OFFSET * ahead)

        def back(view: ExpertView, last: Command) -> Command:
            return replace(last, position=last.position - RETREAT_LENGTH * ahead + RETREAT)

        return [
            Reach(ready),
            Wait(lambda: self.giver.phases_done >= HELD_OUT),
            Reach(at_cube, speed=0.25),
            Grip(FINGER_CLOSED, 0.4),
            Wait(lambda: self.giver.phases_done >= LET_GO),
            Reach(back),
            bring(self._feeder.standoff),
            *self._feeder.delivery(home),
        ]


TAKEN = 4
"""Phases of a `RightHand` that are done when it has gripped the cube."""


class BimanualExpert:
    """Scripted expert that acts with both arms, each of which waits for the other at the hand-over.

    Args:
        env: the environment, unwrapped.
        feeder: what the right arm does once it has the cube.
    """

    def __init__(self, env: BimanualFeedingEnv, feeder: FeedingExpert) -> None:
        self._left, self._right = LeftHand(env), RightHand(env, feeder)
        self._left.taker, self._right.giver = self._right, self._left

    def reset(self) -> None:
        """Begin with the first phases; call it after the environment's reset."""
        self._left.reset()
        self._right.reset()

    def act(self) -> NDArray[np.float32]:
        """Return the next action, (14,): that of the left arm, then that of the right one."""
        return np.concatenate([self._left.act(), self._right.act()])
