"""Forward kinematics of the two arms of the cell, of whole episodes at once."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import build_cell
from robo_manip_baselines.observation.spec import ARM_JOINTS


def gripper_poses(
    joint_position: NDArray[np.float64], arms: tuple[str, ...]
) -> NDArray[np.float64]:
    """Return the poses of the gripper sites for joint positions.

    Args:
        joint_position: (T, A, 6) rad, `ARM_JOINTS` of each arm.
        arms: A names, ``left`` or ``right``.

    Returns:
        (T, A, 7) x, y, z in m and the quaternion w, x, y, z, world frame.
    """
    model = _cell()
    data = mujoco.MjData(model)
    joints = [[model.joint(f"{arm}/{name}").id for name in ARM_JOINTS] for arm in arms]
    places = model.jnt_qposadr[np.array(joints)]
    sites = [model.site(f"{arm}/gripper").id for arm in arms]
    poses = np.empty((len(joint_position), len(arms), 7))
    for row, joint in zip(poses, joint_position, strict=True):
        data.qpos[places] = joint
        mujoco.mj_kinematics(model, data)
        for pose, site in zip(row, sites, strict=True):
            pose[:3] = data.site_xpos[site]
            mujoco.mju_mat2Quat(pose[3:], data.site_xmat[site])
    return poses


@cache
def _cell() -> mujoco.MjModel:
    return build_cell().compile()
