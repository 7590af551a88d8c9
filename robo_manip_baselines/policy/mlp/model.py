"""Behaviour cloning with a perceptron: the smallest complete policy.

Legend: B batch, S elements of the state, K actions of a chunk, A elements of an action.
"""

from __future__ import annotations

import itertools

from torch import Tensor, nn

from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel, masked_mean
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.runs.errors import RequestError


class MlpModel(PolicyModel):
    """Perceptron from the state to a chunk of actions, with an L1 loss."""

    def __init__(self, config: MlpConfig, dims: PolicyDims) -> None:
        super().__init__()
        if dims.cameras:
            raise RequestError("Mlp takes no images; choose --cameras none --object_pose")
        self.chunk_size = config.chunk_size
        sizes = [dims.state, *[config.hidden_size] * config.hidden_layers]
        layers: list[nn.Module] = []
        for size_in, size_out in itertools.pairwise(sizes):
            layers += [nn.Linear(size_in, size_out), nn.LayerNorm(size_out), nn.GELU()]
        layers += [nn.Dropout(config.dropout), nn.Linear(sizes[-1], self.chunk_size * dims.action)]
        self.layers = nn.Sequential(*layers)

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) for the last of (B, 1, S) states."""
        return self.layers(state[:, -1]).float().unflatten(-1, (self.chunk_size, -1))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean absolute error over valid steps as ``loss`` and ``l1``."""
        actions = self.predict(batch.state, batch.images, None)
        error = nn.functional.l1_loss(actions, batch.action, reduction="none")
        l1 = masked_mean(batch.weighted(error), batch.is_pad, batch.num_valid)
        return {"loss": l1, "l1": l1}
