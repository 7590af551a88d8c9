"""From the motion that a person asks for to the joint targets of the arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN
from robo_manip_baselines.envs.mujoco.expert.kinematics import ArmKinematics
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.observation import ARM_JOINTS
from robo_manip_baselines.teleop.device import ArmPose, Floats, TeleopCommand

MAX_LINEAR = 1.0
"""m/s; what is asked for beyond is cut. Twice the fastest motion of the scripted experts."""

MAX_ANGULAR = 6.0
"""rad/s, likewise."""

FLOOR = 0.02
"""m above the table below which the gripper is not commanded: half a cube, and the finger tips
reach 4 cm further."""

LEASH_POSITION, LEASH_ANGLE = 0.01, 0.1
"""m and rad by which the target may be away from what the joints can reach. Beyond, the target is
taken back, so that a hand that pulled too far need not come all the way back first."""

STRAIN = 0.12
"""m by which the target may be ahead of the gripper itself, where the table or a face stops it.
The lag of the servos is a third of it at the largest speed of the experts."""


class SteeredArm:
    """One arm that follows velocities of its gripper, by the experts' inverse kinematics.

    Args:
        arm: ``left`` or ``right``.
    """

    def __init__(self, arm: str) -> None:
        self.arm = arm
        self._kinematics = ArmKinematics(arm)

    def reset(self, joints: Floats, finger: float) -> None:
        """Start from joint targets (6,) rad and a finger's target in m, whoever gave them."""
        self.joints = np.array(joints, dtype=np.float64)
        self.finger = float(finger)
        self._target = self._kinematics.forward(self.joints)

    @property
    def pose(self) -> ArmPose:
        """The commanded pose of the gripper."""
        opening = (self.finger - FINGER_CLOSED) / (FINGER_OPEN - FINGER_CLOSED)
        target = self._target
        return ArmPose(target.translation(), target.rotation().wxyz, float(np.clip(opening, 0, 1)))

    def move(self, command: TeleopCommand, gripper: Floats) -> None:
        """Move for one control period.

        Args:
            command: motion that is asked for; numbers that are not finite count as zero.
            gripper: (3,) m, world: where the gripper is.
        """
        linear = _limited(command.linear, MAX_LINEAR)
        angular = _limited(command.angular, MAX_ANGULAR)
        if command.opening is not None and np.isfinite(command.opening):
            opening = float(np.clip(command.opening, 0.0, 1.0))
            self.finger = FINGER_CLOSED + opening * (FINGER_OPEN - FINGER_CLOSED)
        if not linear.any() and not angular.any():
            return
        before = self._target
        position = before.translation() + linear * CONTROL_PERIOD
        position[2] = max(position[2], min(FLOOR, before.translation()[2]))
        ahead = position - gripper
        strain = float(np.linalg.norm(ahead))
        # Only what pulls further away is stopped: a target that is ahead may always come back.
        if strain > STRAIN and strain > np.linalg.norm(before.translation() - gripper):
            position = before.translation()
        turn = mink.SO3.exp(angular * CONTROL_PERIOD)
        self._target = mink.SE3.from_rotation_and_translation(turn @ before.rotation(), position)
        self.joints = self._kinematics.inverse(self._target, self.joints)
        reached = self._kinematics.forward(self.joints)
        error = self._target.minus(reached)
        if np.linalg.norm(error[:3]) > LEASH_POSITION or np.linalg.norm(error[3:]) > LEASH_ANGLE:
            self._target = reached


class SteeredArms:
    """All arms that a task moves; those that are not steered hold still.

    Args:
        world: the environment, unwrapped.
    """

    def __init__(self, world: FaceEnv) -> None:
        self._world = world
        self.names: tuple[str, ...] = world.observation_spec.arm_names
        self._arms = {name: SteeredArm(name) for name in self.names}
        self._sites = {name: world.model.site(f"{name}/gripper").id for name in self.names}

    @property
    def poses(self) -> dict[str, ArmPose]:
        """Name of an arm -> commanded pose."""
        return {name: arm.pose for name, arm in self._arms.items()}

    def reset(self) -> None:
        """Start from where the arms are; call it after the environment's reset."""
        state = self._world.state()
        self.take(np.column_stack([state.joint_position, state.gripper_position]).ravel())

    def take(self, action: NDArray[np.floating]) -> None:
        """Go on from an action (A,) that something else gave."""
        rows = np.asarray(action, np.float64).reshape(len(self.names), len(ARM_JOINTS) + 1)
        for arm, row in zip(self._arms.values(), rows, strict=True):
            arm.reset(row[:-1], row[-1])

    def act(
        self, commands: Mapping[str, TeleopCommand], steered: Sequence[str]
    ) -> NDArray[np.float32]:
        """Return the action (A,) that follows the commands of the steered arms."""
        for name in steered:
            if name in commands:
                gripper = self._world.data.site_xpos[self._sites[name]]
                self._arms[name].move(commands[name], gripper)
        rows = [np.append(arm.joints, arm.finger) for arm in self._arms.values()]
        return np.concatenate(rows).astype(np.float32)


def _limited(velocity: Floats, limit: float) -> Floats:
    """Return a velocity (3,) cut to a length; zero if it is not finite."""
    velocity = np.asarray(velocity, dtype=np.float64)
    if velocity.shape != (3,) or not np.isfinite(velocity).all():
        return np.zeros(3)
    return velocity * min(1.0, limit / max(float(np.linalg.norm(velocity)), limit))
