"""Loss on the episodes held out: the same examples and the same noise every time."""

from __future__ import annotations

import contextlib

import torch

from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training.batching import BatchLoader
from robo_manip_baselines.training.images import ImageStore
from robo_manip_baselines.training.sampling import ExampleSampler
from robo_manip_baselines.training.setup import TrainSetup

STARTS = 8
"""Examples of each episode: enough for a smooth curve, little of training's time."""


class HeldOutLoss:
    """Mean loss over fixed examples of the episodes held out.

    Args:
        setup: of the run; one or more of its episodes are held out.
        model: its chunk size, observation steps and noise size are read.
        images: of the demonstrations; None without cameras.
        device: of the network.
        autocast: type of autocast, or None.
    """

    def __init__(
        self,
        setup: TrainSetup,
        model: PolicyModel,
        images: ImageStore | None,
        device: torch.device,
        autocast: torch.dtype | None,
    ) -> None:
        seed = derive_seed(setup.config.seed, "validation")
        given, batch_size = setup.demonstrations, setup.config.training.batch_size
        episodes = given.indices(setup.split.validation)
        sampler = ExampleSampler(given.lengths[list(episodes)], "episode", batch_size, seed)
        self._loader = BatchLoader(
            *(given, setup.normalization, episodes, sampler, model),
            seed=seed,
            device=device,
            images=images,
        )
        self._steps = -(-STARTS * len(episodes) // batch_size)
        self._device, self._autocast = device, autocast

    @torch.no_grad()
    def __call__(self, model: PolicyModel) -> dict[str, float]:
        """Return the mean of each part of the loss, every valid step counting the same."""
        was_training = model.training
        model.eval()
        names: list[str] = []
        sums, weight = torch.zeros((), device=self._device), torch.zeros((), device=self._device)
        on = self._autocast is not None
        with (
            torch.autocast(self._device.type, self._autocast, enabled=on),
            contextlib.closing(self._loader.batches(0, self._steps)) as batches,
        ):
            for batch in batches:
                parts = model.loss(batch)
                names = list(parts)
                values = torch.stack([value.double() for value in parts.values()])
                sums = sums + values * batch.num_valid
                weight = weight + batch.num_valid
        model.train(was_training)
        return dict(zip(names, (sums / weight).tolist(), strict=True))
