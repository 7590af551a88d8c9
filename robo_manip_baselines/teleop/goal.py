"""Goal of a gripper that a person sets by dragging or by steps, and the motion that leads there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mink
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.teleop.device import ArmPose, Floats, TeleopCommand

MAX_AHEAD = 0.15
"""m by which steps may set a goal ahead of the gripper; a key that is held would else run away."""


@dataclass(frozen=True)
class Goal:
    """Pose that a gripper is to go to.

    Attributes:
        position: (3,) m, world.
        orientation: (4,) wxyz, world from gripper.
        opening: 0 closed to 1 open.
    """

    position: Floats
    orientation: Floats
    opening: float

    @classmethod
    def at(cls, pose: ArmPose) -> Goal:
        """Return the goal of staying at a commanded pose."""
        return cls(pose.position, pose.orientation, pose.opening)

    def moved(self, offset: Floats, pose: ArmPose) -> Goal:
        """Return the goal moved by (3,) m along the world's axes, not too far from the gripper."""
        ahead = self.position + offset - pose.position
        ahead *= min(1.0, MAX_AHEAD / max(float(np.linalg.norm(ahead)), MAX_AHEAD))
        return replace(self, position=pose.position + ahead)

    def turned(self, rotation: Floats) -> Goal:
        """Return the goal turned by a rotation vector (3,) rad about the gripper's axes."""
        turned = mink.SO3(self.orientation) @ mink.SO3.exp(rotation)
        return replace(self, orientation=turned.wxyz)

    def command(self, pose: ArmPose, speed: float, turn_speed: float) -> TeleopCommand:
        """Return the motion of the next control period that leads from a pose to the goal.

        Args:
            pose: commanded pose of the gripper.
            speed: m/s, the largest.
            turn_speed: rad/s, likewise.
        """
        turn = (mink.SO3(self.orientation) @ mink.SO3(pose.orientation).inverse()).log()
        linear, angular = (
            way * min(1.0 / CONTROL_PERIOD, limit / max(float(np.linalg.norm(way)), 1e-9))
            for way, limit in ((self.position - pose.position, speed), (turn, turn_speed))
        )
        return TeleopCommand(linear, angular, self.opening)
