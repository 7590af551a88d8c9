"""Inverse kinematics of one arm, by differential steps (mink)."""

from __future__ import annotations

import mink
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import attach_arm
from robo_manip_baselines.observation.spec import ARM_JOINTS

POSITION_TOLERANCE = 2e-4
"""m; a fiftieth of the narrowest tolerance of a task."""

ORIENTATION_TOLERANCE = 2e-3
"""rad."""

MAX_ITERATIONS = 20
"""Newton-like steps for one target; following a path at 50 Hz takes one or two."""


class ArmKinematics:
    """Forward and inverse kinematics of the site ``gripper`` of one arm, in the world frame.

    Args:
        arm: ``left`` or ``right``.
    """

    def __init__(self, arm: str) -> None:
        scene = mujoco.MjSpec()
        attach_arm(scene, arm)
        model = scene.compile()
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(
            f"{arm}/gripper", "site", position_cost=1.0, orientation_cost=0.2, lm_damping=1e-6
        )
        self._limits = [mink.ConfigurationLimit(model)]
        self._frame = f"{arm}/gripper"
        self._qpos = np.array([model.joint(f"{arm}/{j}").qposadr[0] for j in ARM_JOINTS])

    def forward(self, joints: NDArray[np.float64]) -> mink.SE3:
        """Return the pose of the gripper at joint angles (6,) rad."""
        self._set(joints)
        return self._configuration.get_transform_frame_to_world(self._frame, "site")

    def inverse(self, target: mink.SE3, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the joints near ``start`` (6,) rad that bring the gripper nearest to ``target``.

        The target is in the world frame; one out of reach gives the nearest pose that the
        iterations find within the limits.
        """
        self._set(start)
        self._task.set_target(target)
        for _ in range(MAX_ITERATIONS):
            error = self._task.compute_error(self._configuration)
            away, turned = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
            if away < POSITION_TOLERANCE and turned < ORIENTATION_TOLERANCE:
                break
            velocity = mink.solve_ik(
                self._configuration, [self._task], 1.0, solver="daqp", limits=self._limits
            )
            self._configuration.integrate_inplace(velocity, 1.0)
        return self._configuration.q[self._qpos].copy()

    def _set(self, joints: NDArray[np.float64]) -> None:
        configuration = self._configuration.q.copy()
        configuration[self._qpos] = joints
        self._configuration.update(configuration)
