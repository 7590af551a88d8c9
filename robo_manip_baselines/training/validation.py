"""Loss on the episodes held out: the same examples and the same noise every time."""

from __future__ import annotations

import contextlib

import torch

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training.batching import BatchLoader
from robo_manip_baselines.training.images import FrameSource
from robo_manip_baselines.training.sampling import Schedule

STARTS = 8
"""Examples of each episode: enough for a smooth curve, a small share of training's time."""


class Validation:
    """Computes the mean loss over fixed examples of some episodes.

    Args:
        demonstrations, normalization, frames: as in training.
        episodes: indices of the episodes that are held out, one or more.
        batch_size: examples at a time.
        seed: of the run; the examples are drawn from it.
        model: whose chunk and noise size count.
        device: where it is.
        autocast: type of autocast, or None.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        normalization: Normalization,
        frames: FrameSource | None,
        *,
        episodes: tuple[int, ...],
        batch_size: int,
        seed: int,
        model: PolicyModel,
        device: torch.device,
        autocast: torch.dtype | None,
    ) -> None:
        own_seed = derive_seed(seed, "validation")
        schedule = Schedule(demonstrations.lengths[list(episodes)], "episode", batch_size, own_seed)
        self._loader = BatchLoader(
            demonstrations,
            normalization,
            episodes,
            schedule,
            chunk_size=model.chunk_size,
            noise_size=model.noise_size,
            seed=own_seed,
            device=device,
            frames=frames,
        )
        self._steps = -(-STARTS * len(episodes) // batch_size)
        self._device = device
        self._autocast = autocast

    @torch.no_grad()
    def __call__(self, model: PolicyModel) -> dict[str, float]:
        """Return the mean of each part of the loss, every valid step counting the same."""
        was_training = model.training
        model.eval()
        names: list[str] = []
        sums: torch.Tensor | None = None
        weight: torch.Tensor | None = None
        on = self._autocast is not None
        with (
            torch.autocast(self._device.type, self._autocast, enabled=on),
            contextlib.closing(self._loader.batches(0, self._steps)) as batches,
        ):
            for batch in batches:
                parts = model.loss(batch)
                names = list(parts)
                values = torch.stack([v.double() for v in parts.values()]) * batch.num_valid
                sums = values if sums is None else sums + values
                weight = batch.num_valid if weight is None else weight + batch.num_valid
        model.train(was_training)
        assert sums is not None
        assert weight is not None
        return dict(zip(names, (sums / weight).tolist(), strict=True))
