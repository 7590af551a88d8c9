"""The part of ACT that is there in training only: which style of acting a chunk of actions shows.

Legend: B batch, S elements of the state, K actions of a chunk, A elements of an action, D hidden
size, Z numbers of the latent.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.positions import sine_positions
from robo_manip_baselines.policy.act.transformer import Encoder, ExactLinear
from robo_manip_baselines.policy.interface import Sizes


class CvaeEncoder(nn.Module):
    """Proposes a distribution of the latent from the state and the demonstrated actions."""

    positions: Tensor

    def __init__(self, config: ActConfig, sizes: Sizes) -> None:
        super().__init__()
        width = config.hidden_size
        self.class_token = nn.Parameter(torch.randn(1, width))
        self.state_projection = ExactLinear(sizes.state, width)
        self.action_projection = ExactLinear(sizes.action, width)
        self.encoder = Encoder(config, config.cvae_layers)
        self.latent_projection = ExactLinear(width, 2 * config.latent_size)
        self.register_buffer(
            "positions", sine_positions(2 + config.chunk_size, width), persistent=False
        )

    def forward(self, state: Tensor, action: Tensor, is_pad: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the variance of the latent, each (B, Z) float32.

        Args:
            state: (B, S).
            action: (B, K, A), finite also where ``is_pad``.
            is_pad: (B, K) bool, actions that are not seen.
        """
        batch = state.shape[0]
        tokens = torch.cat(
            [
                self.class_token.expand(batch, 1, -1),
                self.state_projection(state)[:, None],
                self.action_projection(action),
            ],
            dim=1,
        )
        keep = torch.cat([is_pad.new_ones((batch, 2)), ~is_pad], dim=1)
        encoded = self.encoder(tokens, self.positions, keep)
        mean, log_variance = self.latent_projection(encoded[:, 0]).chunk(2, dim=-1)
        return mean, log_variance


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return KL(N(mean, exp(log_variance)) || N(0, 1)) of each example, (B,), summed over Z."""
    each = -0.5 * (1.0 + log_variance - mean.square() - log_variance.exp())
    return each.sum(dim=-1)
