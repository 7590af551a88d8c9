"""Scripted expert that touches the chin."""

from __future__ import annotations

import numpy as np

from chin_touch.env import FINGER_LENGTH, ChinTouchEnv
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED
from robo_manip_baselines.envs.mujoco.expert.phases import (
    Command,
    ExpertPhase,
    ExpertView,
    Follow,
    Grip,
    PhasedExpert,
    Reach,
    level_at,
)

STANDOFF = np.array([0.12, 0.0, 0.0])
"""m from the chin to where the approach starts, straight in front of it."""

NEAR = np.array([0.04, 0.0, 0.0])
"""m from the chin to the gripper before it slows down."""

TOUCH = np.array([FINGER_LENGTH, 0.0, 0.0])
"""m from the chin to the gripper when its finger tips touch."""


class ChinTouchExpert(PhasedExpert):
    """Close the gripper, go in front of the chin, touch it, withdraw.

    Args:
        env: the environment, unwrapped.
    """

    def __init__(self, env: ChinTouchEnv) -> None:
        super().__init__()
        self._env = env

    def view(self) -> ExpertView:
        """Return the present state."""
        return ExpertView(self._env.target_track())

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""

        def standoff(view: ExpertView, last: Command) -> Command:
            position = view.target() + STANDOFF
            return Command(position, level_at(position), last.finger)

        return [
            Grip(FINGER_CLOSED, 0.4),
            Reach(standoff),
            Follow(NEAR, 0.8),
            Follow(TOUCH, 1.2, speed=0.03),
            Follow(STANDOFF, 5.0),
        ]
