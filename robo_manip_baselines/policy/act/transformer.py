"""Transformer encoder and decoder in the manner of DETR: positions join the queries and keys.

Legend: B batch, L tokens that ask, M tokens that are asked, D hidden size, F feed-forward size,
G attention heads, E = D / G elements of a head.

Under autocast the matrix products run in bf16; the tokens between the blocks, the sums of the
residual branches and the layer norms stay fp32.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.dropout import Dropout


class Linear(nn.Linear):
    """A linear layer that takes what comes in to the type of its weights, where that is smaller."""

    def forward(self, input: Tensor) -> Tensor:
        """Return (..., out_features)."""
        if self.weight.dtype != torch.float32:  # under autocast they are fp32: it does the casting
            input = input.to(self.weight.dtype)
        return nn.functional.linear(input, self.weight, self.bias)


class ExactLinear(nn.Linear):
    """A linear layer in fp32 also under autocast: at the ends, where numbers are positions.

    bf16 keeps 8 bits: of a joint that moves by a radian, steps of several milliradians.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Return (..., out_features), fp32."""
        with torch.autocast(input.device.type, enabled=False):
            return nn.functional.linear(input.float(), self.weight, self.bias)


class Attention(nn.Module):
    """Multi-head attention that never holds its weights in memory."""

    def __init__(self, hidden_size: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query = Linear(hidden_size, hidden_size)
        self.key = Linear(hidden_size, hidden_size)
        self.value = Linear(hidden_size, hidden_size)
        self.out = Linear(hidden_size, hidden_size)

    def forward(
        self, query_BLD: Tensor, key_BMD: Tensor, value_BMD: Tensor, keep_BM: Tensor | None = None
    ) -> Tensor:
        """Return (B, L, D).

        Args:
            query_BLD: tokens that ask, with their positions.
            key_BMD: tokens that are asked, with their positions.
            value_BMD: the same tokens without.
            keep_BM: bool, False for tokens that must not be seen; None to see all.
        """
        mask = None if keep_BM is None else keep_BM[:, None, None, :]
        attended_BGLE = nn.functional.scaled_dot_product_attention(
            self._heads(self.query(query_BLD)),
            self._heads(self.key(key_BMD)),
            self._heads(self.value(value_BMD)),
            attn_mask=mask,
        )
        return self.out(attended_BGLE.transpose(1, 2).flatten(2))

    def _heads(self, x_BLD: Tensor) -> Tensor:
        return x_BLD.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


class LayerNorm(nn.LayerNorm):
    """Layer normalisation in fp32, whatever comes in."""

    def forward(self, input: Tensor) -> Tensor:
        """Return fp32 of the same shape."""
        return nn.functional.layer_norm(
            input.float(), self.normalized_shape, self.weight, self.bias, self.eps
        )


class FeedForward(nn.Module):
    """Two linear layers with a rectifier and dropout between them, on every token."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.widen = Linear(config.hidden_size, config.feedforward_size)
        self.dropout = Dropout(config.dropout)
        self.narrow = Linear(config.feedforward_size, config.hidden_size)

    def forward(self, x_BLD: Tensor) -> Tensor:
        """Return (B, L, D)."""
        return self.narrow(self.dropout(nn.functional.relu(self.widen(x_BLD), inplace=True)))


class Residual(nn.Module):
    """Adds what a block makes of the tokens to the tokens; normalises before or after."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.pre_norm = config.pre_norm
        self.norm = LayerNorm(config.hidden_size)
        self.dropout = Dropout(config.dropout)

    def before(self, x_BLD: Tensor) -> Tensor:
        """Return what the block sees."""
        return self.norm(x_BLD) if self.pre_norm else x_BLD

    def after(self, x_BLD: Tensor, change_BLD: Tensor) -> Tensor:
        """Return the tokens with the block's change."""
        x_BLD = x_BLD + self.dropout(change_BLD)
        return x_BLD if self.pre_norm else self.norm(x_BLD)


class EncoderLayer(nn.Module):
    """Self-attention, then feed-forward."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.attention = Attention(config.hidden_size, config.num_heads)
        self.attention_residual = Residual(config)
        self.feed_forward = FeedForward(config)
        self.feed_forward_residual = Residual(config)

    def forward(self, x_BLD: Tensor, position_LD: Tensor, keep_BL: Tensor | None) -> Tensor:
        """Return (B, L, D)."""
        seen = self.attention_residual.before(x_BLD)
        placed = seen + position_LD
        x_BLD = self.attention_residual.after(x_BLD, self.attention(placed, placed, seen, keep_BL))
        seen = self.feed_forward_residual.before(x_BLD)
        return self.feed_forward_residual.after(x_BLD, self.feed_forward(seen))


class Encoder(nn.Module):
    """A stack of encoder layers."""

    def __init__(self, config: ActConfig, num_layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(num_layers))
        self.norm = LayerNorm(config.hidden_size) if config.pre_norm else nn.Identity()
        _initialize(self)

    def forward(self, x_BLD: Tensor, position_LD: Tensor, keep_BL: Tensor | None = None) -> Tensor:
        """Return (B, L, D), fp32.

        Args:
            x_BLD: tokens.
            position_LD: added to queries and keys of every layer.
            keep_BL: bool, False for tokens that must not be seen; None to see all.
        """
        for layer in self.layers:
            x_BLD = layer(x_BLD, position_LD, keep_BL)
        return self.norm(x_BLD)


class DecoderLayer(nn.Module):
    """Self-attention of the queries, attention to the memory, feed-forward."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.attention = Attention(config.hidden_size, config.num_heads)
        self.attention_residual = Residual(config)
        self.memory_attention = Attention(config.hidden_size, config.num_heads)
        self.memory_residual = Residual(config)
        self.feed_forward = FeedForward(config)
        self.feed_forward_residual = Residual(config)

    def forward(
        self, x_BLD: Tensor, position_LD: Tensor, memory_BMD: Tensor, placed_memory_BMD: Tensor
    ) -> Tensor:
        """Return (B, L, D)."""
        seen = self.attention_residual.before(x_BLD)
        placed = seen + position_LD
        x_BLD = self.attention_residual.after(x_BLD, self.attention(placed, placed, seen))
        placed = self.memory_residual.before(x_BLD) + position_LD
        found = self.memory_attention(placed, placed_memory_BMD, memory_BMD)
        x_BLD = self.memory_residual.after(x_BLD, found)
        seen = self.feed_forward_residual.before(x_BLD)
        return self.feed_forward_residual.after(x_BLD, self.feed_forward(seen))


class Decoder(nn.Module):
    """A stack of decoder layers, of which perhaps only the first are run."""

    def __init__(self, config: ActConfig, num_layers: int, num_run: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(num_layers))
        self.num_run = num_run
        self.norm = LayerNorm(config.hidden_size)
        _initialize(self)
        # What is never run has no gradient, and distributed training waits for every gradient.
        self.layers[num_run:].requires_grad_(False)

    def forward(self, query_LD: Tensor, memory_BMD: Tensor, position_MD: Tensor) -> Tensor:
        """Return (B, L, D), fp32.

        Args:
            query_LD: what stands for the place of each output; the tokens themselves start at 0.
            memory_BMD: tokens of the encoder.
            position_MD: their positions.
        """
        x_BLD = query_LD.new_zeros((memory_BMD.shape[0], *query_LD.shape))
        # The positions of the memory are the same in every layer: added once.
        placed_memory_BMD = memory_BMD + position_MD
        for layer in self.layers[: self.num_run]:
            x_BLD = layer(x_BLD, query_LD, memory_BMD, placed_memory_BMD)
        return self.norm(x_BLD)


def _initialize(module: nn.Module) -> None:
    """Xavier-uniform matrices (DETR), biases of 0."""
    for part in module.modules():
        if isinstance(part, nn.Linear):
            nn.init.xavier_uniform_(part.weight)
            nn.init.zeros_(part.bias)
