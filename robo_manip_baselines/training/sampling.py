"""Which examples each training step sees: a function of the seed and of the step, nothing else.

Legend: E training episodes, b examples of a step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.presets import SAMPLERS, TrainSettings
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.seeds import derive_seed


class Schedule:
    """The examples of every step, so that training can go on at any step without any state.

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
        self, lengths: Sequence[int] | NDArray[np.int64], sampler: str, batch_size: int, seed: int
    ) -> None:
        self.lengths = np.asarray(lengths, dtype=np.int64)
        self.sampler = require_choice("sampler", sampler, SAMPLERS)
        self.batch_size = batch_size
        self.seed = seed
        if batch_size < 1:
            raise RequestError(f"batch_size {batch_size}: must be 1 or more")
        if seed < 0:
            raise RequestError(f"seed {seed}: must be 0 or more")
        if self.lengths.ndim != 1 or not self.lengths.size or self.lengths.min() < 1:
            raise RequestError("training needs at least one episode, each of at least one step")
        by_episode = sampler == "episode"
        self.frames_per_epoch = len(self.lengths) if by_episode else int(self.lengths.sum())
        self._plans: dict[int, NDArray[np.int64]] = {}

    def epochs(self, steps: int) -> float:
        """Return how many epochs so many steps are."""
        return steps * self.batch_size / self.frames_per_epoch

    def total_steps(self, settings: TrainSettings) -> int:
        """Return the budget in optimiser steps, however it was given; the last batch is full."""
        if settings.steps is not None:
            return settings.steps
        assert settings.epochs is not None  # TrainSettings takes exactly one of the two
        return -(-settings.epochs * self.frames_per_epoch // self.batch_size)

    def batch(self, step: int) -> NDArray[np.int64]:
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

    def _epoch(self, epoch: int) -> NDArray[np.int64]:
        """Return all examples of an epoch in their order; a few are kept."""
        kept = self._plans.get(epoch)
        if kept is not None:
            return kept
        rng = np.random.default_rng(derive_seed(self.seed, "schedule", epoch))
        if self.sampler == "episode":
            episodes = rng.permutation(len(self.lengths))
            starts = rng.integers(0, self.lengths[episodes])
        else:
            first = np.concatenate([[0], np.cumsum(self.lengths)])
            frames = rng.permutation(self.frames_per_epoch)
            episodes = np.searchsorted(first, frames, side="right") - 1
            starts = frames - first[episodes]
        plan = np.stack([episodes, starts], axis=1).astype(np.int64, copy=False)
        # Replaced, not changed: another thread may be reading it. Two, for batches on a seam.
        self._plans = {number: self._plans[number] for number in list(self._plans)[-1:]}
        self._plans[epoch] = plan
        return plan


Indices = NDArray[np.int64]


def chunk_rows(
    offsets: Indices, episodes: Indices, starts: Indices, chunk_size: int
) -> tuple[Indices, NDArray[np.bool_]]:
    """Find the rows of chunks that begin in the middle of episodes and end with them at the latest.

    Args:
        offsets: (E + 1,) row at which each episode begins, and the number of rows.
        episodes: (B,) index of each example's episode.
        starts: (B,) first step of each example within its episode.
        chunk_size: K.

    Returns:
        (B, K) rows, the last row of the episode wherever the chunk is past it, and (B, K) whether
        it is.
    """
    rows = (offsets[episodes] + starts)[:, None] + np.arange(chunk_size)
    end = offsets[episodes + 1][:, None]
    return np.minimum(rows, end - 1), rows >= end


def take_chunks(
    action: NDArray[np.float32],
    offsets: Indices,
    episodes: Indices,
    starts: Indices,
    chunk_size: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Take (B, K, A) chunks of the (sum T, A) actions, and (B, K) whether each step is padding.

    Padding repeats the last action of the episode. The other arguments are those of `chunk_rows`.
    """
    rows, is_pad = chunk_rows(offsets, episodes, starts, chunk_size)
    return action[rows], is_pad


def noise_of(seed: int, stream: str, step: int, count: int, size: int) -> Tensor:
    """Return (count, size) standard normal numbers, a function of seed, stream and step."""
    generator = torch.Generator().manual_seed(derive_seed(seed, stream, step))
    return torch.randn(count, size, generator=generator)


class StateNoise:
    """What is added to normalised states; mouth and cube are always shown as they are.

    Args:
        spec: what the elements of the state are.
        robot: ``TrainSettings.state_noise``.
        clock: ``TrainSettings.clock_noise``.
    """

    def __init__(self, spec: ObservationSpec, robot: float = 0.0, clock: float = 0.0) -> None:
        names = spec.vector_names(ObservedNames())
        self._size = len(names)
        self._felt = len(spec.components(ObservedNames())["state"])  # R; they come first
        self._times = [i for i, name in enumerate(names) if name.startswith("t_")]
        self._robot, self._clock = robot, clock

    @classmethod
    def of(cls, spec: ObservationSpec, settings: TrainSettings) -> StateNoise:
        """Return the noise that the settings ask for."""
        return cls(spec, settings.state_noise, settings.clock_noise)

    def draw(self, seed: int, step: int, count: int) -> Tensor | None:
        """Return (b, S) for a step; None if nothing is to be added."""
        if not self._robot and not (self._clock and self._times):
            return None
        drawn = noise_of(seed, "state", step, count, self._felt + 1)
        noise = torch.zeros(count, self._size)
        noise[:, : self._felt] = self._robot * drawn[:, : self._felt]
        # One clock: all the times that are shown are wrong by the same.
        noise[:, self._times] = self._clock * drawn[:, self._felt :]
        return noise
