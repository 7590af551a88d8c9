"""A policy acting through episodes, many at once.

Legend: n environments, b of them that act now, T steps of an episode, S elements of the packed
observation, A elements of an action, N cameras, H and W image height and width.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.workers import EnvPool, StepRequest

EnvIds = NDArray[np.intp]
"""(b,) numbers of environments, none of them twice."""


class ActingPolicy(Protocol):
    """Policy that acts in several environments at once."""

    def reset(self, env_ids: EnvIds, seeds: Sequence[int]) -> None:
        """Start the episodes of these seeds in these environments."""
        ...

    def needs_images(self, env_ids: EnvIds) -> NDArray[np.bool_]:
        """Return, (b,), whether the policy reads the images when it acts next."""
        ...

    def act(
        self, vectors: NDArray[np.float32], images: NDArray[np.uint8] | None, env_ids: EnvIds
    ) -> NDArray[np.float32]:
        """Return the next actions (b, A), each from its own row of the observations alone.

        ``vectors`` are (b, S) packed observations, ``images`` (b, N, H, W, 3), None without
        cameras; rows that need none may hold anything.
        """
        ...


@dataclass
class Recording:
    """Observations, images apart, and actions of an episode; it can be replayed.

    Attributes:
        vectors: T times (S,) float32, packed observations.
        actions: T times (A,) float32.
    """

    vectors: list[NDArray[np.float32]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)


def rollout(
    policy: ActingPolicy,
    envs: EnvPool,
    seeds: Sequence[int],
    *,
    on_episode: Callable[[EpisodeResult, Recording], None] | None = None,
    on_steps: Callable[[int], None] | None = None,
) -> list[EpisodeResult]:
    """Let a policy act through one episode for each seed.

    An environment whose episode has ended starts the next seed at once. The result of an episode
    depends on its seed alone, if the policy makes each row of actions from its own row of
    observations.

    Args:
        policy: for as many environments.
        envs: from ``open_envs``.
        seeds: of the episodes, none of them twice; the results are in their order.
        on_episode: called with every episode that has ended, in the order in which they end.
        on_steps: called with the number of control steps that are taken, all episodes together.

    Raises:
        ValueError: a seed is there twice.
        RuntimeError: a worker process died.
    """
    if len(set(seeds)) != len(seeds):
        raise ValueError("every seed may be there once")
    arrays, waiting = envs.arrays, deque(seeds)
    has_images = bool(envs.config.spec.cameras)
    recordings: dict[int, Recording] = {}
    results: dict[int, EpisodeResult] = {}

    def request(numbers: list[int], seeds: Sequence[int | None]) -> list[StepRequest]:
        needs = policy.needs_images(np.array(numbers, dtype=np.intp)).tolist()
        return [StepRequest(*parts) for parts in zip(numbers, seeds, needs, strict=True)]

    def start(numbers: Sequence[int]) -> list[StepRequest]:
        """Start the next seeds in these environments, as long as there are any."""
        used = list(numbers[: len(waiting)])
        if not used:
            return []
        started = [waiting.popleft() for _ in used]
        policy.reset(np.array(used, dtype=np.intp), started)
        recordings.update((number, Recording()) for number in used)
        return request(used, started)

    def act(numbers: list[int]) -> list[StepRequest]:
        """Let the policy act in these environments."""
        if not numbers:
            return []
        env_ids = np.array(numbers, dtype=np.intp)
        vectors = arrays["vectors"][env_ids]
        images = arrays["images"][env_ids] if has_images else None
        actions = policy.act(vectors, images, env_ids)
        arrays["actions"][env_ids] = actions
        for number, vector, action in zip(numbers, vectors, actions, strict=True):
            recordings[number].vectors.append(vector)
            recordings[number].actions.append(action)
        if on_steps:
            on_steps(len(numbers))
        return request(numbers, [None] * len(numbers))

    requests, running = start(range(len(arrays))), 0
    while requests or running:
        envs.submit(requests)
        running += len(requests)
        answers = envs.wait()
        running -= len(answers)
        for number, result in answers:
            if result is not None:
                results[result.seed] = result
                if on_episode:
                    on_episode(result, recordings[number])
        ready = sorted(number for number, result in answers if result is None)
        ended = sorted(number for number, result in answers if result is not None)
        requests = act(ready) + start(ended)
    return [results[seed] for seed in seeds]
