"""Draws the animation of the README: ``python docs/images/draw_animation.py``.

Left, a shipped policy feeds; right, the scripted experts do the other tasks. All in real time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from itertools import zip_longest
from pathlib import Path

import numpy as np
from PIL import Image

from robo_manip_baselines.envs.mujoco.tasks.face_env import CONTROL_PERIOD, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import TASKS, make_env, task_entry
from robo_manip_baselines.rollout.evaluation import EvaluationConfig, EvaluationPlan
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.rollout import Recording
from robo_manip_baselines.rollout.videos import put_caption, side_by_side
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError

FILE = Path(__file__).with_name("suite.webp")
CHECKPOINT = Path("shipped:forecast")
SEEDS = range(1000, 1020)
STEPS_BETWEEN = 5
"""Control steps from frame to frame: 10 frames/s."""
LARGE, SMALL, COLUMN = (360, 480), (120, 160), 3
"""Height and width of the policy's view and of a task's; tasks in a column."""
CAMERA, CLOSE_UP = "angle", "front_close"
HOLD = 10  # frames at the end
QUALITY = 45  # of WebP, 0 to 100
MAX_BYTES = 2_000_000


def fed() -> Iterator[np.ndarray]:
    """Let the policy feed on the first seed on which it does so strictly; yield its views."""
    plan = EvaluationPlan.of(
        EvaluationConfig(checkpoint=CHECKPOINT, seeds=SEEDS, num_envs=8, workers=2)
    )
    found: dict[int, tuple[EpisodeResult, Recording]] = {}
    plan.run(
        list(SEEDS), lambda result, recording: found.update({result.seed: (result, recording)})
    )
    good = [found[seed] for seed in SEEDS if found[seed][0].is_success_strict]
    if not good:
        raise RequestError(f"{CHECKPOINT} has no strict success on seeds {SEEDS[0]} to {SEEDS[-1]}")
    result, recording = good[0]
    with closing(plan.env.make(image_size=LARGE, render_size=None, multisamples=4)) as env:
        world = world_of(env)
        world.renders_images = False
        env.reset(seed=result.seed)
        for step, action in enumerate(recording.actions):
            if step % STEPS_BETWEEN == 0:
                views = world.renderer.render(world.data, [CAMERA, CLOSE_UP])
                text = f"ACT with a forecast (trained policy), {step * CONTROL_PERIOD:.0f} s"
                view = put_caption(views[CAMERA], text)
                height, width = np.array(LARGE) // 3
                view[:height, -width:] = views[CLOSE_UP][::3, ::3][:height, :width]
                yield view
            env.step(action)


def demonstrated(task: str) -> Iterator[np.ndarray]:
    """Let the task's first expert act on the first seed on which it succeeds; yield its views."""
    expert = next(iter(task_entry(task).experts))
    size = {"image_size": SMALL, "multisamples": 4}
    with closing(make_env(task, cameras=(), arms=task_entry(task).arms[0], **size)) as env:
        world = world_of(env)
        for seed in SEEDS:
            frames, ended = [], False
            actor = world.task.make_expert(expert, world)
            env.reset(seed=seed)
            actor.reset()
            info = {"is_success": False}
            while not ended:
                if world.step_count % STEPS_BETWEEN == 0:
                    view = world.renderer.render(world.data, [CAMERA])[CAMERA]
                    frames.append(put_caption(view, task.removesuffix("Env")))
                _, _, terminated, truncated, info = env.step(actor.act())
                ended = terminated or truncated
            if info["is_success"]:
                yield from frames
                return
    raise RequestError(f"the expert of {task} succeeds on no seed")


def held(clips: Iterable[Iterable[np.ndarray]]) -> Iterator[list[np.ndarray]]:
    """Yield the frames of all clips together; those that end hold their last one."""
    last: list[np.ndarray] = []
    for images in zip_longest(*clips):
        last = [old if new is None else new for new, old in zip_longest(images, last)]
        yield last


def main() -> None:
    others = [name for name in TASKS if name != "FeedingEnv"]
    frames: list[Image.Image] = []
    for large, *small in held([fed(), *map(demonstrated, others)]):
        empty = np.full((*SMALL, 3), 255, np.uint8)
        small += [empty] * (-len(small) % COLUMN)
        columns = [np.concatenate(small[i : i + COLUMN]) for i in range(0, len(small), COLUMN)]
        frames.append(Image.fromarray(side_by_side([large, *columns])))
    frames += frames[-1:] * HOLD
    period = round(1000 * STEPS_BETWEEN * CONTROL_PERIOD)
    frames[0].save(
        FILE, save_all=True, append_images=frames[1:], duration=period, loop=0, quality=QUALITY,
        method=6,
    )  # fmt: skip
    size = FILE.stat().st_size
    if size > MAX_BYTES:
        raise RequestError(f"{FILE} has {size} bytes, more than {MAX_BYTES}; lower QUALITY")
    print(f"{FILE}: {len(frames)} frames, {size} bytes")


if __name__ == "__main__":
    run_command(main)
