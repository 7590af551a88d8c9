"""Slots: environments that run beside one another, each in an episode of its own.

Legend: n slots, S elements of the state, A elements of an action, N cameras, H and W image height
and width.

Orders go to slots, and an event comes back for each. Numbers go through ``SlotArrays``, which may
lie in memory that processes share.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face_env import world_of
from robo_manip_baselines.evaluation.episode_watch import EpisodeWatch
from robo_manip_baselines.evaluation.result import EpisodeResult
from robo_manip_baselines.evaluation.task import Task
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.vector import to_vector

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
