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
import signal
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    EpisodeMetrics,
    TaskEntry,
    make_env,
    task_entry,
)
from robo_manip_baselines.observation import ARM_JOINTS, ObservationSpec
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError

_PATIENCE = 5.0
"""s for a worker to end by itself, when the run is over, before it is killed."""


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
        if seed is None:
            observation, _, terminated, truncated, info = env.step(self.arrays["actions"][number])
            metrics = self._metrics[number]
            metrics.update(info)
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
                )
                return StepResult(number, result)
        else:
            observation, _ = env.reset(seed=seed)
            self._metrics[number] = self.config.task.make_metrics()
            self._seeds[number] = seed
        self.arrays["vectors"][number] = world.vector
        if needs_images:
            for camera, key in enumerate(self.config.spec.image_keys()):
                self.arrays["images"][number, camera] = observation[key]
        return StepResult(number, None)


@dataclass
class _Worker:
    """Process, the pipe to it, and the requests that it is working on."""

    process: Any
    pipe: Connection
    requests: Sequence[StepRequest] = ()


class WorkerEnvs:
    """Environments dealt out to worker processes."""

    def __init__(self, config: EnvConfig, num_envs: int, workers: int) -> None:
        self.config = config
        # Spawned, not forked: an OpenGL context does not survive a fork.
        context = multiprocessing.get_context("spawn")
        buffer = context.RawArray("B", num_envs * config.row_type.itemsize)
        self.arrays = np.frombuffer(buffer, config.row_type)
        self._workers: list[_Worker] = []
        try:
            for _ in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs, config, buffer), daemon=True)
                self._workers.append(_Worker(process, ours))
                with _without_interrupts():
                    process.start()
                theirs.close()  # so that the pipe ends when the worker does
        except BaseException:
            self.close()
            raise

    def submit(self, requests: Sequence[StepRequest]) -> None:
        """Send requests to environments that have none."""
        for number, worker in enumerate(self._workers):
            mine = [r for r in requests if r.env_id % len(self._workers) == number]
            if mine:
                worker.requests = mine
                with contextlib.suppress(OSError):  # it has died; ``wait`` finds out why
                    worker.pipe.send(mine)

    def wait(self) -> list[StepResult]:
        """Wait until some environments have answered, and return the answers.

        Raises:
            RequestError: a worker could not do what was requested.
            RuntimeError: a worker failed or died.
        """
        busy = [worker for worker in self._workers if worker.requests]
        ready = wait([worker.pipe for worker in busy])
        answers: list[StepResult] = []
        for worker in busy:
            if worker.pipe in ready:
                answers += _receive(worker)
                worker.requests = ()
        return answers

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            worker.pipe.close()  # a worker ends when it finds that its pipe has
        for worker in self._workers:
            if worker.process.pid is not None:
                worker.process.join(_PATIENCE)
                if worker.process.is_alive():
                    worker.process.kill()
                    worker.process.join()
                worker.process.close()
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


def _receive(worker: _Worker) -> list[StepResult]:
    """Return the answers of a worker, or raise its error."""
    try:
        answer = worker.pipe.recv()
    except (EOFError, OSError) as error:
        worker.process.join(_PATIENCE)
        numbers = ", ".join(str(request.env_id) for request in worker.requests)
        raise RuntimeError(
            f"the worker process of environments {numbers} died (exit code "
            f"{worker.process.exitcode}); if it was killed for lack of memory, take fewer "
            "--num_envs or --workers"
        ) from error
    if isinstance(answer, RequestError):
        raise answer
    if isinstance(answer, str):
        raise RuntimeError(f"a worker process failed:\n{answer}")
    return answer


def _work(pipe: Connection, config: EnvConfig, buffer: Any) -> None:
    """Carry out requests until the pipe ends; errors are reported through it."""
    answer: list[StepResult] | RequestError | str
    with contextlib.closing(LocalEnvs(config, np.frombuffer(buffer, config.row_type))) as here:
        while True:
            try:
                requests = pipe.recv()
            except (EOFError, OSError):  # the run is over
                return
            try:
                here.submit(requests)
                answer = here.wait()
            except RequestError as error:
                answer = RequestError(str(error))
            except Exception:
                answer = traceback.format_exc()
            try:
                pipe.send(answer)
            except OSError:
                return


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Let a process that starts here never see Ctrl-C, which reaches the whole process group.

    It would print a traceback of its own; this process ends it. Signals that come meanwhile are
    seen afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Python starts it with the first process, and lets SIGINT through again while doing so.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
