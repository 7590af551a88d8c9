"""Examples and noise of each training step: functions of the seed and of the step, nothing else.

Legend: E training episodes, b examples of a step, K actions of a chunk, O observation steps, S
elements of the state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.presets import SAMPLERS, TrainSettings, require_at_least
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.seeds import derive_seed

Indices = NDArray[np.int64]


class ExampleSampler:
    """Sampler without state, so that training can be resumed at any step.

    With the sampler ``episode`` (the paper's) an epoch draws one start from each episode, uniform
    over its steps; with ``frame`` an epoch visits every step of every episode once. Either way
    the order is random and another in each epoch. Epochs follow one another without a seam: every
    batch is full, and one may hold the end of an epoch and the beginning of the next. So 2000
    epochs of 50 episodes in batches of 8 (paper, Table III) are 12 500 steps.

    Attributes:
        lengths: (E,) int64, steps of each training episode.
        sampler, batch_size, seed: as given.
        frames_per_epoch: examples of an epoch.

    Raises:
        RequestError: unknown sampler, batch size below 1, a negative seed, or no episodes.
    """

    def __init__(
        self, lengths: Sequence[int] | Indices, sampler: str, batch_size: int, seed: int
    ) -> None:
        self.lengths = np.asarray(lengths, dtype=np.int64)
        self.sampler = require_choice("sampler", sampler, SAMPLERS)
        self.batch_size = batch_size
        self.seed = seed
        require_at_least(1, self, "batch_size")
        require_at_least(0, self, "seed")
        if self.lengths.ndim != 1 or not self.lengths.size or self.lengths.min() < 1:
            raise RequestError("training needs at least one episode, each of at least one step")
        by_episode = sampler == "episode"
        self.frames_per_epoch = len(self.lengths) if by_episode else int(self.lengths.sum())
        self._epochs: dict[int, Indices] = {}

    def epochs(self, steps: int) -> float:
        """Return the number of epochs in so many steps."""
        return steps * self.batch_size / self.frames_per_epoch

    def total_steps(self, settings: TrainSettings) -> int:
        """Return the budget in optimiser steps; the last batch is full."""
        if settings.steps is not None:
            return settings.steps
        assert settings.epochs is not None  # TrainSettings takes exactly one of the two
        return -(-settings.epochs * self.frames_per_epoch // self.batch_size)

    def batch(self, step: int) -> Indices:
        """Return the examples of a step, (b, 2): index of the training episode, first step in it.

        Raises:
            ValueError: a negative step.
        """
        if step < 0:
            raise ValueError(f"step {step}: must be 0 or more")
        numbers = np.arange(step * self.batch_size, (step + 1) * self.batch_size)
        epochs, places = np.divmod(numbers, self.frames_per_epoch)
        parts = [self._epoch(int(e))[places[epochs == e]] for e in np.unique(epochs)]
        return np.concatenate(parts)

    def _epoch(self, epoch: int) -> Indices:
        """Return all examples of an epoch in their order; two epochs are cached."""
        cached = self._epochs.get(epoch)
        if cached is not None:
            return cached
        rng = np.random.default_rng(derive_seed(self.seed, "schedule", epoch))
        if self.sampler == "episode":
            episodes = rng.permutation(len(self.lengths))
            starts = rng.integers(0, self.lengths[episodes])
        else:
            first = np.concatenate([[0], np.cumsum(self.lengths)])
            frames = rng.permutation(self.frames_per_epoch)
            episodes = np.searchsorted(first, frames, side="right") - 1
            starts = frames - first[episodes]
        examples = np.stack([episodes, starts], axis=1).astype(np.int64, copy=False)
        # Replaced, not changed: another thread may be reading it. Two, for batches on a seam.
        self._epochs = {number: self._epochs[number] for number in list(self._epochs)[-1:]}
        self._epochs[epoch] = examples
        return examples


def chunk_rows(
    offsets: Indices, episodes: Indices, starts: Indices, chunk_size: int
) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the rows of chunks of actions; past the end of an episode its last row is repeated.

    Args:
        offsets: (E + 1,) row at which each episode begins, and the number of rows.
        episodes: (b,) index of each example's episode.
        starts: (b,) step of each example within its episode.
        chunk_size: K.

    Returns:
        (b, K) rows, and (b, K) whether each is padding.
    """
    rows = (offsets[episodes] + starts)[:, None] + np.arange(chunk_size)
    end = offsets[episodes + 1][:, None]
    return np.minimum(rows, end - 1), rows >= end


def window_rows(offsets: Indices, episodes: Indices, starts: Indices, n_obs_steps: int) -> Indices:
    """Return the rows (b, O) of windows of observations that end with each example's step.

    Before the start of an episode its first row is repeated. Arguments as in `chunk_rows`.
    """
    first = offsets[episodes][:, None]
    rows = first + starts[:, None] + np.arange(1 - n_obs_steps, 1)
    return np.maximum(rows, first)


def step_noise(seed: int, stream: str, step: int, count: int, size: int) -> Tensor:
    """Return (count, size) standard normal numbers, a function of seed, stream and step."""
    generator = torch.Generator().manual_seed(derive_seed(seed, stream, step))
    return torch.randn(count, size, generator=generator)


class StateNoise:
    """Gaussian noise on normalised states: on proprioception and on the clock.

    Mouth and cube are left as they are.

    Args:
        spec: of the observations.
        names: of the task's target and objects.
        robot: ``TrainSettings.state_noise``.
        clock: ``TrainSettings.clock_noise``.
    """

    def __init__(
        self, spec: ObservationSpec, names: ObservedNames, robot: float = 0.0, clock: float = 0.0
    ) -> None:
        elements = spec.vector_names(names)
        self._size = len(elements)
        self._robot_size = len(spec.components(names)["state"])  # they come first
        self._times = [i for i, name in enumerate(elements) if name.startswith("t_")]
        self._robot, self._clock = robot, clock

    def draw(self, seed: int, step: int, count: int) -> Tensor | None:
        """Return (count, S) for a step; None where there is no noise."""
        if not self._robot and not (self._clock and self._times):
            return None
        drawn = step_noise(seed, "state", step, count, self._robot_size + 1)
        noise = torch.zeros(count, self._size)
        noise[:, : self._robot_size] = self._robot * drawn[:, : self._robot_size]
        # One clock: all times of an observation are off by the same.
        noise[:, self._times] = self._clock * drawn[:, self._robot_size :]
        return noise
