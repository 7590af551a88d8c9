"""How fast episodes are evaluated: control steps per second, by number of slots and of processes.

The policy holds the arm still and costs nothing, so the figures are those of the environments, of
the shared memory and of the pipes; ``--checkpoint`` puts a trained policy in its place. Starting
the processes is left out: every slot has done its first reset before the clock runs.

Example: python benchmarks/rollout_speed.py --num_envs 1 8 --workers 0 2
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.spec import parse_image_size
from robo_manip_baselines.rollout.rollout import Policy, rollout
from robo_manip_baselines.rollout.workers import Order, Task, open_environments
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Options:
    """Run short episodes in every arrangement and print how fast they went."""

    num_envs: tuple[int, ...] = (1, 2, 8)
    """Slots to try."""
    workers: tuple[int, ...] = (0, 1, 2)
    """Numbers of processes to try; 0 is none but the main one."""
    steps: int = 1600
    """Control steps of each measurement, all slots together."""
    image_size: str = "480x640"
    """Height x width of the camera's images."""
    checkpoint: Path | None = None
    """A trained policy to act, in place of none at all."""


class Still:
    """Holds the arm where it is, and looks at every image if there are any."""

    def reset(self, slots: NDArray[np.intp]) -> None:
        """Nothing to forget."""

    def looks(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Always."""
        return np.ones(len(slots), np.bool_)

    def act(
        self, observations: Mapping[str, NDArray[Any]], slots: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Return the joints' positions; the gripper stays open."""
        state = observations["state"]
        return np.concatenate([state[:, :6], state[:, 12:13]], axis=1)


def measure(task: Task, num_envs: int, workers: int, steps: int, policy: Policy) -> float:
    """Return control steps per second."""
    length = -(-steps // num_envs)
    short = replace(task, env_kwargs={"max_episode_steps": length})
    with open_environments(short, num_envs, workers) as environments:
        environments.submit([Order(slot, 0, True) for slot in range(num_envs)])
        waiting = num_envs
        while waiting:
            waiting -= len(environments.wait())
        begin = time.perf_counter()
        results = rollout(policy, environments, range(num_envs))
        return sum(result.steps for result in results) / (time.perf_counter() - begin)


def policy_for(options: Options, num_envs: int) -> Policy:
    """Make the policy that acts."""
    if options.checkpoint is None:
        return Still()
    from robo_manip_baselines.policy.checkpoint import load_model, read_checkpoint
    from robo_manip_baselines.policy.execution import ChunkPolicy
    from robo_manip_baselines.training.device import choose_device

    checkpoint, device = read_checkpoint(options.checkpoint), choose_device("auto")
    if device.type == "cpu" and not checkpoint.spec.cameras:
        import torch

        torch.set_num_threads(1)  # as Rollout.py does
    return ChunkPolicy(
        load_model(checkpoint, device),
        checkpoint.spec,
        checkpoint.normalization,
        checkpoint.acting,
        slots=num_envs,
        device=device,
    )


def main() -> None:
    """Measure and print."""
    options = parse(Options, "python benchmarks/rollout_speed.py --num_envs 1 8 --workers 0 2")
    if min(options.num_envs) < 1 or min(options.workers) < 0 or options.steps < 1:
        raise RequestError("num_envs and steps are 1 or more, workers 0 or more")
    for name, task in tasks(options).items():
        print(f"\n{name}: control steps/s")
        print("num_envs  " + "".join(f"{f'workers {w}':>12}" for w in options.workers))
        for num_envs in options.num_envs:
            cells = [
                measure(task, num_envs, workers, options.steps, policy_for(options, num_envs))
                for workers in options.workers
            ]
            print(f"{num_envs:<10}" + "".join(f"{cell:12.0f}" for cell in cells), flush=True)


def tasks(options: Options) -> dict[str, Task]:
    """Return what to measure, by name."""
    if options.checkpoint is not None:
        from robo_manip_baselines.policy.checkpoint import read_checkpoint

        checkpoint = read_checkpoint(options.checkpoint)
        cameras = ", ".join(checkpoint.spec.cameras) or "state only"
        return {f"{checkpoint.policy}, {cameras}": Task(checkpoint.env, checkpoint.spec)}
    height, width = parse_image_size(options.image_size)
    blind = ObservationSpec(obs="current_pred", cameras=(), object_pose=True)
    seeing = replace(blind, cameras=("front_close",), image_size=(height, width))
    named = {"state only": blind, f"one camera, {height}x{width}": seeing}
    if problem := opengl_problem():
        print(f"no camera: {problem}")
        named = {"state only": blind}
    return {name: Task("FeedingEnv", spec) for name, spec in named.items()}


if __name__ == "__main__":
    run_command(main)
