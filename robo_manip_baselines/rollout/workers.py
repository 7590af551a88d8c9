"""The environment in which a policy is evaluated, as something that can be sent to a process."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.vx300s import ARM_JOINTS
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.feeding.metrics import EpisodeWatch
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.state import to_vector, vector_names
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Task:
    """An environment and what a policy is shown there.

    Attributes:
        env: name of the environment.
        spec: what the policy is shown.
        env_kwargs: further arguments of the environment, such as ``face_motion``.
    """

    env: str
    spec: ObservationSpec
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    @property
    def vector_size(self) -> int:
        """S, elements of all vectors together."""
        return len(vector_names(self.spec))

    @property
    def action_size(self) -> int:
        """A: joints and gripper of each arm."""
        return (len(ARM_JOINTS) + 1) * len(self.spec.arm_names)

    @property
    def image_shape(self) -> tuple[int, ...]:
        """(N, H, W, 3) of the images of all cameras."""
        return (len(self.spec.cameras), *self.spec.image_size, 3)

    def make(self, **changes: Any) -> gymnasium.Env[Any, Any]:
        """Make the environment, without cameras: whoever wants a view renders it.

        Args:
            **changes: arguments that shall differ.

        Raises:
            RequestError: an argument is not valid.
        """
        spec = self.spec
        arguments = {
            "obs": spec.obs,
            "horizon": spec.horizon,
            "cameras": (),
            "image_size": spec.image_size,
            "object_pose": spec.object_pose,
            "arms": spec.arms,
            "corruption": spec.corruption and asdict(spec.corruption),
            **self.env_kwargs,
            **changes,
        }
        return make_env(self.env, **arguments)


_ALIGNMENT = 64
"""bytes; a cache line, so that no two arrays share one."""


class Order(NamedTuple):
    """What a slot shall do.

    Attributes:
        slot: its number.
        seed: of the episode to start; None to take one step with the slot's action.
        looks: whether the policy will look at the cameras afterwards.
    """

    slot: int
    seed: int | None
    looks: bool


class Event(NamedTuple):
    """A slot has done what it was ordered to.

    Attributes:
        slot: its number.
        result: what the episode came to, if it ended.
    """

    slot: int
    result: EpisodeResult | None


class Environments(Protocol):
    """Slots, wherever they run."""

    @property
    def task(self) -> Task:
        """The environment of every slot."""
        ...

    @property
    def arrays(self) -> SlotArrays:
        """What goes in and comes out."""
        ...

    def submit(self, orders: Sequence[Order]) -> None:
        """Give orders to slots that have none."""
        ...

    def wait(self) -> list[Event]:
        """Wait until some slots are done, and say which."""
        ...


class SlotArrays:
    """One row for each slot, laid out in one stretch of memory.

    Args:
        task: says the sizes.
        slots: n.
        buffer: of ``size`` bytes, zeros; made here if None.

    Attributes:
        vectors: (n, S) float32, all vectors of the observation joined.
        actions: (n, A) float32, the next action.
        images: (n, N, H, W, 3) uint8.
    """

    def __init__(self, task: Task, slots: int, buffer: Any = None) -> None:
        memory = bytearray(self.size(task, slots)) if buffer is None else buffer
        parts, start = [], 0
        for shape, kind in _layout(task, slots):
            count = int(np.prod(shape))
            parts.append(np.frombuffer(memory, kind, count, start).reshape(shape))
            start += _padded(count * np.dtype(kind).itemsize)
        self.vectors, self.actions, self.images = parts
        self.slots = slots

    @staticmethod
    def size(task: Task, slots: int) -> int:
        """Bytes that the arrays need."""
        return sum(
            _padded(int(np.prod(shape)) * np.dtype(kind).itemsize)
            for shape, kind in _layout(task, slots)
        )


class SlotEnvironments:
    """The environments of some slots, in this process; made when first needed.

    Args:
        task: the environment of every slot.
        arrays: rows of these slots, and of others.
    """

    def __init__(self, task: Task, arrays: SlotArrays) -> None:
        self.task, self.arrays = task, arrays
        self._envs: dict[int, gymnasium.Env[Any, Any]] = {}
        self._watches: dict[int, EpisodeWatch] = {}
        self._events: list[Event] = []

    def submit(self, orders: Sequence[Order]) -> None:
        """Carry out the orders."""
        self._events += [self._carry_out(order) for order in orders]

    def wait(self) -> list[Event]:
        """Return what has been done."""
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        """Free the OpenGL contexts."""
        for env in self._envs.values():
            env.close()
        self._envs.clear()

    def _carry_out(self, order: Order) -> Event:
        slot, task = order.slot, self.task
        if order.seed is None:
            env, watch = self._envs[slot], self._watches[slot]
            observation, _, terminated, truncated, info = env.step(self.arrays.actions[slot])
            watch.see(info)
            if terminated or truncated:
                return Event(slot, watch.result(info))
        else:
            env = self._envs.get(slot)
            if env is None:
                env = self._envs[slot] = task.make()
            observation, _ = env.reset(seed=order.seed)
            segment = world_of(env).segment
            self._watches[slot] = EpisodeWatch(task.env, order.seed, segment.clip, segment.subject)
        self.arrays.vectors[slot] = to_vector(task.spec, observation)
        if order.looks and task.spec.cameras:
            world = world_of(env)
            views = world.renderer.render(world.data, task.spec.cameras)
            for camera, view in enumerate(views.values()):
                self.arrays.images[slot, camera] = view
        return Event(slot, None)


def _layout(task: Task, slots: int) -> list[tuple[tuple[int, ...], Any]]:
    return [
        ((slots, task.vector_size), np.float32),
        ((slots, task.action_size), np.float32),
        ((slots, *task.image_shape), np.uint8),
    ]


def _padded(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def split_vector(
    spec: ObservationSpec, vector: NDArray[np.float32]
) -> dict[str, NDArray[np.float32]]:
    """Take a joined vector (..., S) apart into the vectors of the observation (..., n)."""
    components = spec.components()
    ends = np.cumsum([len(names) for names in components.values()])
    return dict(zip(components, np.split(vector, ends[:-1], axis=-1), strict=True))


_PATIENCE = 5.0
"""s for a worker to end by itself, when the run is over, before it is killed."""


@contextlib.contextmanager
def open_environments(task: Task, num_envs: int, workers: int) -> Iterator[Environments]:
    """Give slots, and free them at the end.

    Args:
        task: the environment of every slot.
        num_envs: slots, 1 or more.
        workers: processes that step them; 0 steps them in this one.

    Raises:
        RequestError: a number is too small.
    """
    if num_envs < 1:
        raise RequestError(f"num_envs {num_envs}: must be 1 or more")
    if workers < 0:
        raise RequestError(f"workers {workers}: must be 0 (no process of their own) or more")
    if workers:
        with WorkerEnvironments(task, num_envs, min(workers, num_envs)) as environments:
            yield environments
    else:
        with contextlib.closing(SlotEnvironments(task, SlotArrays(task, num_envs))) as here:
            yield here


@dataclass
class _Worker:
    """A process and the pipe to it.

    Attributes:
        orders: what it is working on.
    """

    process: Any
    pipe: Connection
    orders: Sequence[Order] = ()


class WorkerEnvironments:
    """Slots dealt out to worker processes. Use as a context manager.

    Args:
        task: the environment of every slot.
        num_envs: slots.
        workers: processes.
    """

    def __init__(self, task: Task, num_envs: int, workers: int) -> None:
        self.task = task
        # Spawned, not forked: an OpenGL context does not survive a fork.
        context = multiprocessing.get_context("spawn")
        buffer = context.RawArray("B", SlotArrays.size(task, num_envs))
        self.arrays = SlotArrays(task, num_envs, buffer)
        self._workers: list[_Worker] = []
        try:
            for _ in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_work, args=(theirs, task, num_envs, buffer), daemon=True
                )
                self._workers.append(_Worker(process, ours))
                with _without_interrupts():
                    process.start()
                theirs.close()  # so that the pipe ends when the worker does
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> WorkerEnvironments:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def submit(self, orders: Sequence[Order]) -> None:
        """Give orders to slots that have none."""
        for number, worker in enumerate(self._workers):
            mine = [order for order in orders if order.slot % len(self._workers) == number]
            if mine:
                worker.orders = mine
                with contextlib.suppress(OSError):  # it has died; ``wait`` finds out why
                    worker.pipe.send(mine)

    def wait(self) -> list[Event]:
        """Wait until some slots are done, and say which.

        Raises:
            RequestError: what a worker could not do was asked for wrongly.
            RuntimeError: a worker failed or died.
        """
        busy = {worker.pipe: worker for worker in self._workers if worker.orders}
        events: list[Event] = []
        for pipe in wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            events += _receive(worker)
            worker.orders = ()
        return events

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


def _receive(worker: _Worker) -> list[Event]:
    """Return the events that a worker reports, or raise what it failed with."""
    try:
        answer = worker.pipe.recv()
    except (EOFError, OSError) as error:
        worker.process.join(_PATIENCE)
        slots = ", ".join(str(order.slot) for order in worker.orders)
        raise RuntimeError(
            f"the worker process of slots {slots} died (exit code {worker.process.exitcode}); "
            "if it was killed for lack of memory, take fewer --num_envs or --workers"
        ) from error
    if isinstance(answer, RequestError):
        raise answer
    if isinstance(answer, str):
        raise RuntimeError(f"a worker process failed:\n{answer}")
    return answer


def _work(pipe: Connection, task: Task, num_envs: int, buffer: Any) -> None:
    """Carry out orders until the pipe ends; what goes wrong is reported through it."""
    answer: list[Event] | RequestError | str
    with contextlib.closing(SlotEnvironments(task, SlotArrays(task, num_envs, buffer))) as here:
        while True:
            try:
                orders = pipe.recv()
            except (EOFError, OSError):  # the run is over
                return
            try:
                here.submit(orders)
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
