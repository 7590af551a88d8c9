"""Draws the images of docs/robot.md: ``python docs/images/draw_robot.py``."""

from __future__ import annotations

from pathlib import Path

import cv2
import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.envs.mujoco.cell.scene import add_cube, build_cell, look_at
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, HOME_QPOS
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.observation.spec import ARM_JOINTS
from robo_manip_baselines.runs.command import run_command

FOLDER = Path(__file__).parent
HOLDING = FINGER_CLOSED + 0.02
VIEWS = {
    "whole": ((0.05, -0.35, 0.50), (0.33, 0.5, 0.18), 38.0),
    "gripper": ((0.02, 0.28, 0.52), (0.26, 0.5, 0.30), 38.0),
}


def main() -> None:
    spec = build_cell()
    add_cube(spec)
    for name, (position, target, fovy) in VIEWS.items():
        quat = look_at(position, target)
        spec.worldbody.add_camera(name=name, pos=position, quat=quat, fovy=fovy)
    model = spec.compile()
    data = mujoco.MjData(model)
    for arm in ("left", "right"):
        for joint, angle in zip(ARM_JOINTS, HOME_QPOS, strict=True):
            data.joint(f"{arm}/{joint}").qpos = angle
        data.joint(f"{arm}/left_finger").qpos = HOLDING
        data.joint(f"{arm}/right_finger").qpos = -HOLDING
    mujoco.mj_kinematics(model, data)
    gripper = data.site("right/gripper")
    data.joint("cube").qpos[:3] = gripper.xpos
    mujoco.mju_mat2Quat(data.joint("cube").qpos[3:], gripper.xmat)
    mujoco.mj_forward(model, data)
    with CameraRenderer(model, 480, 640, shadows=True, multisamples=4) as renderer:
        for file, cameras in (("robot_arm", tuple(VIEWS)), ("robot_cameras", CAMERAS)):
            image = np.hstack(list(renderer.render(data, cameras).values()))
            cv2.imwrite(str(FOLDER / f"{file}.png"), image[..., ::-1])


if __name__ == "__main__":
    run_command(main)
