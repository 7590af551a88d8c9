"""Draws the pictures of the tasks, ``task_*.png``: ``python docs/images/draw_tasks.py [NAMES]``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import require_choice

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Picture:
    """Picture of a task from near by, when the expert has come to a moment.

    Attributes:
        env, seed: of the episode.
        until: whether the moment has come.
        look_at: (3,) m, world.
        distance: m, of the camera.
        kwargs: of the environment.
    """

    env: str
    seed: int
    until: Callable[[Any], Any]
    look_at: Callable[[Any], NDArray[np.float64]]
    distance: float
    kwargs: Mapping[str, Any] = field(default_factory=dict)

    def draw(self) -> Image:
        """Return the picture, (500, 800, 3)."""
        with closing(make_env(self.env, cameras=(), **self.kwargs)) as env:
            world: Any = env.unwrapped
            actor = world.task.make_expert("reactive", world)
            world.reset(seed=self.seed)
            actor.reset()
            while not self.until(world):
                world.step(actor.act())
            camera = mujoco.MjvCamera()
            camera.lookat[:] = self.look_at(world)
            camera.distance, camera.azimuth, camera.elevation = self.distance, 128.0, -12.0
            with mujoco.Renderer(world.model, 500, 800) as renderer:
                renderer.update_scene(world.data, camera)
                return np.asarray(renderer.render(), np.uint8)


TIMES = (2.3, 4.4, 6.2, 9.3)
"""s of bimanual feeding: lifted, in both hands, passed, at the mouth."""


def bimanual() -> Image:
    """Return four views of the camera ``angle``, (600, 800, 3)."""
    look: Any = {"cameras": (), "image_size": (300, 400), "shadows": True, "multisamples": 4}
    views: list[Image] = []
    with closing(make_env("BimanualFeedingEnv", render_mode="rgb_array", **look)) as env:
        world: Any = env.unwrapped
        world.reset(seed=0)
        expert = world.task.make_expert("reactive", world)
        expert.reset()
        for time in TIMES:
            while world.time < time:
                world.step(expert.act())
            views.append(world.render())
    return np.vstack([np.hstack(views[:2]), np.hstack(views[2:])])


PICTURES: Mapping[str, Callable[[], Image]] = {
    "feeding": Picture(
        env="FeedingEnv",
        seed=3,
        until=lambda world: np.linalg.norm(world.cube_offset) <= 0.05,
        look_at=lambda world: world.cube_position - [0.0, 0.0, 0.02],
        distance=0.55,
    ).draw,
    "spoon": Picture(
        env="FeedingEnv",
        seed=3,
        until=lambda world: np.linalg.norm(world.cube_offset) <= 0.04,
        look_at=lambda world: world.cube_position - [-0.02, 0.0, 0.01],
        distance=0.38,
        kwargs={"utensil": "spoon"},
    ).draw,
    "drinking": Picture(
        env="DrinkingEnv",
        seed=3,
        until=lambda world: world.liquid.delivered_share >= 0.34,
        look_at=lambda world: world.cup_position - [0.045, 0.0, 0.02],
        distance=0.34,
    ).draw,
    "bimanual_feeding": bimanual,
}
"""Name of a picture -> function that draws it."""


def main() -> None:
    """Draw the pictures that are named; all if none is."""
    for name in sys.argv[1:] or PICTURES:
        image = PICTURES[require_choice("picture", name, PICTURES)]()
        file = Path(__file__).with_name(f"task_{name}.png")
        cv2.imwrite(str(file), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
        print(file)


if __name__ == "__main__":
    run_command(main)
