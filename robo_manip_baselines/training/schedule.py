"""Which examples each training step sees: a function of the seed and of the step, nothing else.

Legend: E training episodes, b examples of a step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.errors import RequestError, require_choice
from robo_manip_baselines.training.seeds import derive_seed
from robo_manip_baselines.training.settings import SAMPLERS, TrainSettings


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
