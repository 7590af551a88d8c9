"""The public ACT code's way of computing, for `act_step.py` to measure ours against.

Written from the architecture alone, with the same layers and sizes: fp32, attention that holds and
drops its weights, a pass of the ResNet for every camera over float images in (channels, height,
width) order, frozen normalisation of its own, every decoder layer run and only the first one read.

Legend: B batch, L tokens, D hidden size, N cameras, H and W image height and width.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.model import ActModel, kl_divergence
from robo_manip_baselines.policy.act.resnet import FrozenBatchNorm, ResNet18
from robo_manip_baselines.policy.interface import Batch, PolicyDims


class PublicAttention(nn.Module):
    """Attention with its weights in memory, dropout among them."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.inner = nn.MultiheadAttention(
            config.hidden_size, config.num_heads, config.dropout, batch_first=True
        )

    def forward(self, query: Tensor, key: Tensor, value: Tensor, pad: Tensor | None) -> Tensor:
        """Return (B, L, D)."""
        return self.inner(query, key, value, key_padding_mask=pad, need_weights=True)[0]


class PublicLayer(nn.Module):
    """A layer of encoder or decoder: the decoder's attends to a memory too."""

    def __init__(self, config: ActConfig, decoder: bool) -> None:
        super().__init__()
        width, drop = config.hidden_size, config.dropout
        self.attention = nn.ModuleList(PublicAttention(config) for _ in range(1 + decoder))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2 + decoder))
        self.dropouts = nn.ModuleList(nn.Dropout(drop) for _ in range(2 + decoder))
        self.feed_forward = nn.Sequential(
            nn.Linear(width, config.feedforward_size),
            nn.ReLU(),
            nn.Dropout(drop),
            nn.Linear(config.feedforward_size, width),
        )

    def forward(
        self,
        x: Tensor,
        position: Tensor,
        pad: Tensor | None = None,
        memory: Tensor | None = None,
        memory_position: Tensor | None = None,
    ) -> Tensor:
        """Return the tokens (B, L, D) after the layer."""
        placed = x + position
        found = self.attention[0](placed, placed, x, pad)
        x = self.norms[0](x + self.dropouts[0](found))
        if memory is not None and memory_position is not None:
            found = self.attention[1](x + position, memory + memory_position, memory, None)
            x = self.norms[1](x + self.dropouts[1](found))
        return self.norms[-1](x + self.dropouts[-1](self.feed_forward(x)))


class PublicResNet(ResNet18):
    """The same network in the public order: normalisation on its own, images as they come."""

    def forward(self, images: Tensor) -> Tensor:
        """Return (I, 512, h, w) for normalised (I, 3, H, W) float images."""

        def run(x: Tensor, conv: nn.Module, norm: nn.Module) -> Tensor:
            scale, shift = cast("FrozenBatchNorm", norm).scale_and_shift()
            return conv(x) * scale[:, None, None] + shift[:, None, None]

        x = torch.relu_(run(images, self.conv1, self.bn1))
        x = nn.functional.max_pool2d(x, 3, 2, 1)
        for name in ("layer1", "layer2", "layer3", "layer4"):
            for block in cast("Any", self.get_submodule(name)):
                change = torch.relu_(run(x, block.conv1, block.bn1))
                change = run(change, block.conv2, block.bn2)
                x = x if block.downsample is None else run(x, *block.downsample)
                x = torch.relu_(x + change)
        return x


class PublicWay(ActModel):
    """ActModel's parameters outside the Transformers, computed with as the public code does."""

    def __init__(self, config: ActConfig, dims: PolicyDims) -> None:
        super().__init__(config, dims)

        def stack(number: int, decoder: bool = False) -> nn.ModuleList:
            return nn.ModuleList(PublicLayer(config, decoder) for _ in range(number))

        cvae = self.cvae
        assert cvae is not None
        cvae.encoder = cast("Any", stack(config.cvae_layers))
        self.encoder = cast("Any", stack(config.encoder_layers))
        self.decoder = cast("Any", stack(config.decoder_layers, decoder=True))
        self.final_norm = nn.LayerNorm(config.hidden_size)
        if self.vision is not None:
            self.vision.backbone = PublicResNet()

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss and its parts; ``batch.images`` are (B, 1, N, 3, H, W) from 0 to 1."""
        cvae = self.cvae
        assert cvae is not None
        tokens = torch.cat(
            [
                cvae.class_token.expand(len(batch.state), 1, -1),
                cvae.state_projection(batch.state),
                cvae.action_projection(batch.action),
            ],
            dim=1,
        )
        pad = torch.cat([torch.zeros_like(batch.is_pad[:, :2]), batch.is_pad], dim=1)
        for layer in cast("Any", cvae.encoder):
            tokens = layer(tokens, cvae.positions, pad)
        mean, log_variance = cvae.latent_projection(tokens[:, 0]).chunk(2, dim=-1)
        latent = mean + (0.5 * log_variance).exp() * batch.noise
        error = (self._actions(batch.state, batch.images, latent) - batch.action).abs()
        l1 = (error * ~batch.is_pad[..., None]).mean()
        kl = kl_divergence(mean, log_variance).mean()
        return {"loss": l1 + self.config.kl_weight * kl, "l1": l1, "kl": kl}

    def _actions(self, state: Tensor, images: Tensor | None, latent: Tensor | None) -> Tensor:
        if latent is None:
            latent = state.new_zeros((len(state), self.config.latent_size))
        tokens = [self.latent_projection(latent)[:, None], self.state_projection(state)]
        position = self.token_positions
        if self.vision is not None and images is not None:
            mean, scale = self.vision.backbone.mean / 255.0, self.vision.backbone.scale * 255.0
            normal = (images[:, -1] - mean) * scale
            for camera in range(normal.shape[1]):
                features = self.vision.projection(self.vision.backbone(normal[:, camera]))
                tokens.append(features.flatten(2).transpose(1, 2))
            position = torch.cat([position, self.vision.positions.flatten(0, 1)])
        memory = torch.cat(tokens, dim=1)
        for layer in cast("Any", self.encoder):
            memory = layer(memory, position)
        x = torch.zeros_like(self.queries).expand(len(state), -1, -1)
        outputs = []
        for layer in cast("Any", self.decoder):
            x = layer(x, self.queries, None, memory, position)
            outputs.append(self.final_norm(x))
        return self.action_head(torch.stack(outputs)[0])
