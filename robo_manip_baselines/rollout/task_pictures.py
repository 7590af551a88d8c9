"""Pictures of tasks: a scripted expert at work, and at its first success; tiles of many tasks."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.envs.mujoco.tasks.face_env import RENDER_CAMERA, FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.rollout.videos import put_caption, side_by_side
from robo_manip_baselines.runs.files import atomic_file

Image = NDArray[np.uint8]

VIEW = (300, 400)
"""Height and width of each view, pixels."""

CLOSE_UP = "front_close"
"""Camera of the view at the success; ``angle`` shows the expert at work."""

EVERY = 25
"""Control steps between the states that are kept for the first view."""


def draw_task(name: str, seed: int) -> Image:
    """Return two views of an episode of the task's first expert, (H, 2 W, 3) uint8.

    The whole cell, half-way to the first success, and the face at the success; at the end of an
    episode without.
    """
    with closing(make_env(name, cameras=())) as env:
        world = world_of(env)
        expert = world.task.make_expert(next(iter(world.task.experts)), world)
        env.reset(seed=seed)
        expert.reset()
        states, is_over = [copy.copy(world.data)], False
        while not is_over:
            *_, terminated, truncated, info = env.step(expert.act())
            is_over = terminated or truncated or bool(info["is_success"])
            if not world.step_count % EVERY:
                states.append(copy.copy(world.data))
        views = [(states[len(states) // 2], RENDER_CAMERA), (world.data, CLOSE_UP)]
        drawn = side_by_side([_view(world, data, camera) for data, camera in views])
    return np.asarray(put_caption(drawn, name), np.uint8)


def tile_tasks(names: Sequence[str], seed: int) -> Image:
    """Return the pictures of tasks, two in a row, the last row filled up with white."""
    pictures = [draw_task(name, seed) for name in names]
    columns = min(2, len(pictures))
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % columns)
    rows = math.ceil(len(pictures) / columns)
    tiles = [np.hstack(pictures[columns * row : columns * (row + 1)]) for row in range(rows)]
    return np.asarray(np.vstack(tiles), np.uint8)


def write_png(path: Path, image: Image) -> None:
    """Write an RGB image."""
    with atomic_file(path) as partial:
        partial.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def _view(world: FaceEnv, data: mujoco.MjData, camera: str) -> Image:
    with CameraRenderer(world.model, *VIEW, shadows=True, multisamples=4) as renderer:
        return renderer.render(data, [camera])[camera]
