"""Speed of evaluation: control steps per second, by number of environments and of processes.

Above each table stand, for one environment in this process, the speed of MuJoCo alone (the same
physics steps, with nothing read between them: what no environment of this model can exceed) and
that of ``env.step`` alone, without policy, metrics and shared memory.

The policy holds the arm still and costs nothing, so the figures are those of the environments, of
the shared memory and of the pipes; ``--checkpoint`` puts a trained policy in its place. Starting
the processes is left out: every environment has done its first reset before the clock runs.

On a machine that others use, ``--cpu_time`` counts the processor time of the main process instead.

Example: python benchmarks/rollout_speed.py --num_envs 1 8 --workers 0 2
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.spec import ImageSize
from robo_manip_baselines.rollout.evaluation import EvaluationConfig, EvaluationPlan
from robo_manip_baselines.rollout.rollout import ActingPolicy, rollout
from robo_manip_baselines.rollout.workers import EnvConfig, StepRequest, open_envs
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Options:
    """Run short episodes in every arrangement and print their speed."""

    envs: tuple[str, ...] = ("FeedingEnv",)
    """Tasks; a checkpoint brings its own."""
    num_envs: tuple[int, ...] = (1, 2, 8)
    """Numbers of environments to try."""
    workers: tuple[int, ...] = (0, 1, 2)
    """Numbers of processes to try; 0 is none but the main one."""
    steps: int = 1600
    """Control steps of each measurement, all environments together."""
    image_size: ImageSize = (480, 640)
    """Height x width of the camera's images."""
    checkpoint: Path | None = None
    """A trained policy that acts in place of none at all."""
    cpu_time: bool = False
    """Count processor time; only with --workers 0."""


TURN = 50
"""Control steps for which the physics and ``env.step`` take turns."""

ARM_STATE = 14
"""Numbers of an arm in an observation: 6 positions, 6 velocities, gripper, and its velocity."""


class Still:
    """Holds the arms where they are, and needs every image if there are any.

    Args:
        arms: how many.
    """

    def __init__(self, arms: int = 1) -> None:
        self._arms = arms

    def reset(self, env_ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        """Nothing to forget."""

    def needs_images(self, env_ids: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Always."""
        return np.ones(len(env_ids), np.bool_)

    def act(
        self,
        vectors: NDArray[np.float32],
        images: NDArray[np.uint8] | None,
        env_ids: NDArray[np.intp],
    ) -> NDArray[np.float32]:
        """Return the positions of joints and grippers."""
        state = vectors[:, : self._arms * ARM_STATE].reshape(-1, self._arms, ARM_STATE)
        actions = np.concatenate([state[..., :6], state[..., 12:13]], axis=-1)
        return actions.reshape(len(vectors), -1)


def measure(
    config: EnvConfig,
    num_envs: int,
    workers: int,
    steps: int,
    policy: ActingPolicy,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Return control steps per second."""
    length = -(-steps // num_envs)
    short = replace(config, env_kwargs={**config.env_kwargs, "max_episode_steps": length})
    with open_envs(short, num_envs, workers) as envs:
        envs.submit([StepRequest(number, 0, True) for number in range(num_envs)])
        waiting = num_envs
        while waiting:
            waiting -= len(envs.wait())
        begin = clock()
        results = rollout(policy, envs, range(num_envs))
        return sum(result.steps for result in results) / (clock() - begin)


def alone(config: EnvConfig, steps: int, clock: Callable[[], float]) -> tuple[float, float]:
    """Return control steps per second of the physics alone, and of ``env.step``.

    The arms are held still. They take turns, so that other programs slow both down alike.
    """
    spent = np.zeros(2)
    turns, length = max(1, steps // TURN), min(steps, TURN)
    with contextlib.closing(config.make()) as env:
        world = world_of(env)
        env.reset(seed=0)
        model, data = world.model, world.data
        action = data.ctrl[[model.actuator(name).id for name in world.action_names]]
        for _ in range(turns):
            begin = clock()
            for _ in range(length):
                env.step(action)
            middle = clock()
            mujoco.mj_step(model, data, length * world.substeps)
            spent += clock() - middle, middle - begin
            env.reset(seed=0)
    physics, step = turns * length / spent
    return float(physics), float(step)


def main() -> None:
    """Measure and print."""
    options = parse(Options, "python benchmarks/rollout_speed.py --num_envs 1 8 --workers 0 2")
    if min(options.num_envs) < 1 or min(options.workers) < 0 or options.steps < 1:
        raise RequestError("num_envs and steps are 1 or more, workers 0 or more")
    if options.cpu_time and set(options.workers) != {0}:
        raise RequestError("cpu_time goes with --workers 0: the main process does all of the work")
    clock = time.process_time if options.cpu_time else time.perf_counter
    plan = None
    if options.checkpoint is not None:
        plan = EvaluationPlan.of(EvaluationConfig(options.checkpoint, range(1)))
        if plan.device.type == "cpu" and not plan.env.spec.cameras:
            import torch

            torch.set_num_threads(1)  # as Rollout.py does
    for name, config in configs(options, plan).items():
        physics, step = alone(config, options.steps, clock)
        print(f"\n{name}: control steps/s; physics alone {physics:.0f}, env.step {step:.0f}")
        print("num_envs  " + "".join(f"{f'workers {w}':>12}" for w in options.workers))
        for num_envs in options.num_envs:
            cells = [
                measure(
                    config,
                    num_envs,
                    workers,
                    options.steps,
                    plan.make_policy(num_envs) if plan else Still(len(config.spec.arm_names)),
                    clock,
                )
                for workers in options.workers
            ]
            print(f"{num_envs:<10}" + "".join(f"{cell:12.0f}" for cell in cells), flush=True)


def configs(options: Options, plan: EvaluationPlan | None) -> dict[str, EnvConfig]:
    """Return the environments to measure, by name."""
    if plan:
        cameras = ", ".join(plan.env.spec.cameras) or "state only"
        return {f"{plan.checkpoint.policy}, {cameras}": plan.env}
    height, width = options.image_size
    state = ObservationSpec(obs="current_pred", cameras=(), object_pose=True)
    camera = replace(state, cameras=("front_close",), image_size=(height, width))
    named = {"state only": state, f"one camera, {height}x{width}": camera}
    if problem := opengl_problem():
        print(f"no camera: {problem}")
        named = {"state only": state}
    found = {}
    for env in options.envs:
        task = task_entry(env)
        for name, spec in named.items():
            has_objects = bool(task.names.objects)
            own = replace(spec, arms=task.arms[0], object_pose=has_objects)
            found[f"{env}, {name}"] = EnvConfig(env, own)
    return found


if __name__ == "__main__":
    run_command(main)
