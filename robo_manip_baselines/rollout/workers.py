"""Environments that run beside one another, in this process or in workers.

Step requests go to environments, and a step result comes back for each. Observations, actions and
images lie in memory that all processes share. It has no name: a file in ``/dev/shm`` (or in the
temporary folder, where that is too small) that is deleted as soon as it is open and handed to the
workers as it is, so that nothing can be left behind, however a run ends. What goes through the
pipes is small: requests, and results of episodes.

Legend: n environments, S elements of the packed observation, A elements of an action, N cameras, H
and W image height and width.
"""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    EpisodeMetrics,
    TaskEntry,
    make_env,
    task_entry,
)
from robo_manip_baselines.envs.mujoco.tasks.safety import SafetyMetrics
from robo_manip_baselines.observation import ARM_JOINTS, ObservationSpec
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.processes import Worker, WorkerDiedError, close_workers, wait_for


@dataclass(frozen=True)
class EnvConfig:
    """Environment in which a policy acts; can be sent to a process.

    Attributes:
        env: name of the task.
        spec: what the policy is shown.
        env_kwargs: further arguments of the environment, such as ``face_motion``.
    """

    env: str
    spec: ObservationSpec
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    @property
    def task(self) -> TaskEntry:
        """Entry of the task."""
        return task_entry(self.env)

    @property
    def vector_size(self) -> int:
        """S, elements of all vectors together."""
        return len(self.spec.vector_names(self.task.names))

    @property
    def action_size(self) -> int:
        """A: joints and gripper of each arm."""
        return (len(ARM_JOINTS) + 1) * len(self.spec.arm_names)

    @property
    def row_type(self) -> np.dtype[Any]:
        """Row of an environment in the shared memory.

        ``vectors`` (S,) float32 is the packed observation, ``actions`` (A,) float32 the next
        action, ``images`` (N, H, W, 3) uint8.
        """
        vectors = ("vectors", np.float32, (self.vector_size,))
        actions = ("actions", np.float32, (self.action_size,))
        images = ("images", np.uint8, (len(self.spec.cameras), *self.spec.image_size, 3))
        return np.dtype([vectors, actions, images])

    def make(self, **changes: Any) -> gymnasium.Env[Any, Any]:
        """Make the environment, with changes to its arguments.

        Raises:
            RequestError: an argument is not valid.
        """
        kwargs = {**self.spec.env_kwargs(), **self.env_kwargs, **changes}
        # Gymnasium's checker would miss the images of steps in which no policy needs them.
        return make_env(self.env, disable_env_checker=True, **kwargs)


class StepRequest(NamedTuple):
    """Request to an environment.

    Attributes:
        env_id: number of the environment.
        seed: of the episode to start; None to take one step with the environment's action.
        needs_images: whether the policy will read the images afterwards.
    """

    env_id: int
    seed: int | None
    needs_images: bool


class StepResult(NamedTuple):
    """Answer to a request.

    Attributes:
        env_id: number of the environment.
        result: of the episode, if it has ended.
    """

    env_id: int
    result: EpisodeResult | None


class LocalEnvs:
    """Environments in this process; made when first needed.

    Args:
        config: of every environment.
        arrays: (n,) of ``config.row_type``, rows of these environments and of others.
    """

    def __init__(self, config: EnvConfig, arrays: NDArray[np.void]) -> None:
        self.config, self.arrays = config, arrays
        self._envs: dict[int, gymnasium.Env[Any, Any]] = {}
        self._metrics: dict[int, EpisodeMetrics] = {}
        self._safety: dict[int, SafetyMetrics] = {}
        self._seeds: dict[int, int] = {}
        self._answers: list[StepResult] = []

    def submit(self, requests: Sequence[StepRequest]) -> None:
        """Carry out the requests."""
        self._answers += [self._carry_out(request) for request in requests]

    def wait(self) -> list[StepResult]:
        """Return the answers."""
        answers, self._answers = self._answers, []
        return answers

    def close(self) -> None:
        """Free the OpenGL contexts."""
        for env in self._envs.values():
            env.close()
        self._envs.clear()

    def _carry_out(self, request: StepRequest) -> StepResult:
        number, seed, needs_images = request
        if number not in self._envs:
            self._envs[number] = self.config.make()
        env = self._envs[number]
        world = world_of(env)
        world.renders_images = needs_images
        world.measures_proximity = True
        if seed is None:
            observation, _, terminated, truncated, info = env.step(self.arrays["actions"][number])
            metrics = self._metrics[number]
            metrics.update(info)
            self._safety[number].update(info)
            if terminated or truncated:
                (failure, columns), time = metrics.result(info), info["completion_time"]
                result = EpisodeResult(
                    env=self.config.env,
                    seed=self._seeds[number],
                    is_success=bool(info["is_success"]),
                    is_success_strict=bool(info["is_success_strict"]),
                    # Times are sums of 0.02 s; microseconds hide what floating point adds to them.
                    completion_time=None if time is None else round(float(time), 6),
                    steps=world.step_count,
                    failure=failure,
                    motion_clip=world.segment.clip,
                    motion_subject=world.segment.subject,
                    motion=str(world.motion),
                    columns=columns,
                    frames_without_detection=world.frames_without_detection,
                    safety=self._safety[number].result(info),
                )
                return StepResult(number, result)
        else:
            observation, _ = env.reset(seed=seed)
            self._metrics[number] = self.config.task.make_metrics()
            self._safety[number] = SafetyMetrics(CONTROL_PERIOD)
            self._seeds[number] = seed
        self.arrays["vectors"][number] = world.vector
        if needs_images:
            for camera, key in enumerate(self.config.spec.image_keys()):
                self.arrays["images"][number, camera] = observation[key]
        return StepResult(number, None)


class _EnvServer:
    """Environments in a worker process: step requests in, step results out."""

    def __init__(self, config: EnvConfig, buffer: Any) -> None:
        self._envs = LocalEnvs(config, np.frombuffer(buffer, config.row_type))
        self.close = self._envs.close

    def __call__(self, requests: Sequence[StepRequest]) -> list[StepResult]:
        self._envs.submit(requests)
        return self._envs.wait()


class WorkerEnvs:
    """Environments dealt out to worker processes."""

    def __init__(self, config: EnvConfig, num_envs: int, workers: int) -> None:
        self.config = config
        buffer = multiprocessing.get_context("spawn").RawArray(
            "B", num_envs * config.row_type.itemsize
        )
        self.arrays = np.frombuffer(buffer, config.row_type)
        self._workers: list[Worker] = []
        self._requests: dict[Worker, Sequence[StepRequest]] = {}  # of the workers that have some
        try:
            for _ in range(workers):
                self._workers.append(Worker(_EnvServer, config, buffer))
        except BaseException:
            self.close()
            raise

    def submit(self, requests: Sequence[StepRequest]) -> None:
        """Send requests to environments that have none."""
        for number, worker in enumerate(self._workers):
            mine = [r for r in requests if r.env_id % len(self._workers) == number]
            if mine:
                self._requests[worker] = mine
                worker.submit(mine)

    def wait(self) -> list[StepResult]:
        """Wait until some environments have answered, and return the answers.

        Raises:
            RequestError: a worker could not do what was requested.
            RuntimeError: a worker failed or died.
        """
        answers: list[StepResult] = []
        for worker in wait_for(list(self._requests)):
            try:
                answers += worker.receive()
            except WorkerDiedError as error:
                numbers = ", ".join(str(request.env_id) for request in self._requests[worker])
                raise RuntimeError(
                    f"the worker process of environments {numbers} died ({error}); if it was "
                    "killed for lack of memory, take fewer --num_envs or --workers"
                ) from error
            del self._requests[worker]
        return answers

    def close(self) -> None:
        """End the workers; at once if they are at work."""
        close_workers(self._workers, at_once=bool(self._requests))
        self._workers.clear()


EnvPool = LocalEnvs | WorkerEnvs


@contextlib.contextmanager
def open_envs(config: EnvConfig, num_envs: int, workers: int) -> Iterator[EnvPool]:
    """Yield environments, and free them at the end.

    Args:
        config: of every environment.
        num_envs: 1 or more.
        workers: processes that step them; 0 steps them in this one.

    Raises:
        RequestError: a number is too small.
    """
    if num_envs < 1:
        raise RequestError(f"num_envs {num_envs}: must be 1 or more")
    if workers < 0:
        raise RequestError(f"workers {workers}: must be 0 (no process of their own) or more")
    envs = (
        WorkerEnvs(config, num_envs, min(workers, num_envs))
        if workers
        else LocalEnvs(config, np.zeros(num_envs, config.row_type))
    )
    with contextlib.closing(envs):
        yield envs
