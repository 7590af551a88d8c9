"""Behaviour cloning with a perceptron: the smallest whole policy, and the pattern for the next.

Legend: B batch, S elements of the state, K actions of a chunk, A elements of an action.
"""

from __future__ import annotations

import itertools

from torch import Tensor, nn

from robo_manip_baselines.policy.interface import Batch, PolicyModel, Sizes, masked_mean
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.runs.errors import RequestError


class MlpModel(PolicyModel):
    """State in, chunk of actions out, L1 loss."""

    def __init__(self, config: MlpConfig, sizes: Sizes) -> None:
        super().__init__()
        if sizes.cameras:
            raise RequestError("Mlp sees no images; say --cameras none --object_pose")
        self.chunk_size = config.chunk_size
        widths = [sizes.state, *[config.hidden_size] * config.hidden_layers]
        layers: list[nn.Module] = []
        for wide, narrow in itertools.pairwise(widths):
            layers += [nn.Linear(wide, narrow), nn.LayerNorm(narrow), nn.GELU()]
        layers += [
            nn.Dropout(config.dropout),
            nn.Linear(widths[-1], self.chunk_size * sizes.action),
        ]
        self.layers = nn.Sequential(*layers)

    def predict(self, state: Tensor, images: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) for a (B, S) state."""
        return self.layers(state).float().unflatten(-1, (self.chunk_size, -1))

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean absolute error over valid steps as ``loss`` and ``l1``."""
        error = nn.functional.l1_loss(
            self.predict(batch.state, batch.images), batch.action, reduction="none"
        )
        l1 = masked_mean(error, batch.is_pad, batch.num_valid)
        return {"loss": l1, "l1": l1}
