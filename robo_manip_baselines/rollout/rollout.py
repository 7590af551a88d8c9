"""Letting a policy act through episodes, many at once.

Legend: n slots, b slots that act now, T steps of an episode, S elements of the state, A elements
of an action.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.workers import Environments, Order, split_vector


class Policy(Protocol):
    """What acts. Slots are numbers of episodes that run at once, none of them twice in a call."""

    def reset(self, env_ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        """Start episodes of these seeds in these environments."""
        ...

    def needs_images(self, env_ids: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return (b,) whether the images of each environment's next observation are needed."""
        ...

    def act(
        self, observations: Mapping[str, NDArray[Any]], env_ids: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Return the next actions (b, A), each from its own row of observations (b, ...) alone."""
        ...


@dataclass
class Recording:
    """What a policy saw, images apart, and did in an episode; it can be acted out again.

    Attributes:
        vectors: T times (S,) float32, all vectors of the observation joined.
        actions: T times (A,) float32.
    """

    vectors: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)


def rollout(
    policy: Policy,
    environments: Environments,
    seeds: Sequence[int],
    *,
    on_episode: Callable[[EpisodeResult, Recording], None] | None = None,
) -> list[EpisodeResult]:
    """Let a policy act through one episode for each seed.

    A slot whose episode has ended starts the next seed at once. What an episode comes to depends on
    its seed alone, if the policy makes each row of actions from its own row of observations.

    Args:
        policy: has as many slots as the environments.
        environments: from ``open_environments``.
        seeds: of the episodes, none of them twice.
        on_episode: called with every episode that has ended, in the order in which they end.

    Returns:
        Results in the order of the seeds.

    Raises:
        ValueError: a seed is there twice.
        RuntimeError: a worker process died.
    """
    if len(set(seeds)) != len(seeds):
        raise ValueError("every seed may be there once")
    arrays, waiting = environments.arrays, deque(seeds)
    recordings: dict[int, Recording] = {}
    results: dict[int, EpisodeResult] = {}

    def start(slots: Sequence[int]) -> list[Order]:
        """Start the next seeds in these slots, as long as there are any."""
        used = slots[: len(waiting)]
        if not used:
            return []
        numbers = np.array(used, dtype=np.intp)
        begun = [waiting.popleft() for _ in used]
        policy.reset(numbers, begun)
        recordings.update((slot, Recording()) for slot in used)
        looks = policy.needs_images(numbers).tolist()
        return [Order(*order) for order in zip(used, begun, looks, strict=True)]

    def act(slots: list[int]) -> list[Order]:
        """Let the policy act in these slots."""
        if not slots:
            return []
        numbers = np.array(slots, dtype=np.intp)
        vectors = arrays.vectors[numbers]
        observations: dict[str, NDArray[Any]] = {**split_vector(environments.task.spec, vectors)}
        for camera, key in enumerate(environments.task.spec.image_keys()):
            observations[key] = arrays.images[numbers, camera]
        actions = policy.act(observations, numbers)
        arrays.actions[numbers] = actions
        for slot, vector, action in zip(slots, vectors, actions, strict=True):
            recordings[slot].vectors.append(vector)
            recordings[slot].actions.append(action)
        looks = policy.needs_images(numbers).tolist()
        return [Order(slot, None, look) for slot, look in zip(slots, looks, strict=True)]

    orders, running = start(range(arrays.slots)), 0
    while orders or running:
        environments.submit(orders)
        running += len(orders)
        events = environments.wait()
        running -= len(events)
        for slot, result in events:
            if result is not None:
                results[result.seed] = result
                if on_episode:
                    on_episode(result, recordings[slot])
        ready = sorted(slot for slot, result in events if result is None)
        ended = sorted(slot for slot, result in events if result is not None)
        orders = act(ready) + start(ended)
    return [results[seed] for seed in seeds]
