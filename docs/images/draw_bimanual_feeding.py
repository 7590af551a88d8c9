"""Draws the image of docs/bimanual_feeding.md: ``python docs/images/draw_bimanual_feeding.py``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.env import BimanualFeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.command import run_command

SEED = 0
TIMES = (2.3, 4.4, 6.2, 9.3)
"""s: lifted, in both hands, passed, at the mouth."""

SIZE = (300, 400)
LOOK = {"cameras": (), "image_size": SIZE, "shadows": True, "multisamples": 4}


def main() -> None:
    views: list[np.ndarray] = []
    with closing(make_env("BimanualFeedingEnv", render_mode="rgb_array", **LOOK)) as env:
        world = cast(BimanualFeedingEnv, env.unwrapped)
        world.reset(seed=SEED)
        expert = world.task.make_expert("reactive", world)
        expert.reset()
        for time in TIMES:
            while world.time < time:
                world.step(expert.act())
            image = world.render()
            assert image is not None
            views.append(image)
    picture = np.vstack([np.hstack(views[:2]), np.hstack(views[2:])])
    path = Path(__file__).parent / "task_bimanual_feeding.png"
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(path)


if __name__ == "__main__":
    run_command(main)
