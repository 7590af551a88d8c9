"""Draws the picture of FeedingEnv in the README: ``python docs/images/draw_feeding.py``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import cv2
import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.command import run_command

SEED, NEAR = 3, 0.05


def main() -> None:
    with closing(make_env("FeedingEnv", cameras=())) as env:
        world = env.unwrapped
        assert isinstance(world, FeedingEnv)
        actor = ENTRY.make_expert("reactive", world)
        world.reset(seed=SEED)
        actor.reset()
        while np.linalg.norm(world.cube_offset) > NEAR:
            world.step(actor.act())
        camera = mujoco.MjvCamera()
        camera.lookat[:] = world.cube_position - np.array([0.0, 0.0, 0.02])
        camera.distance, camera.azimuth, camera.elevation = 0.55, 128.0, -12.0
        with mujoco.Renderer(world.model, 500, 800) as renderer:
            renderer.update_scene(world.data, camera)
            image = np.asarray(renderer.render())
    file = Path(__file__).with_name("task_feeding.png")
    cv2.imwrite(str(file), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    run_command(main)
