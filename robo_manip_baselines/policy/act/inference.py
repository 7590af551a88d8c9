"""Prediction of a trained ACT network, with little but the products themselves.

The legend of shapes is that of ``model.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from robo_manip_baselines.policy.act.model import (
        ActModel,
        Attention,
        DecoderLayer,
        EncoderLayer,
        FeedForward,
        Residual,
    )

Step = Callable[[Tensor], Tensor]


class Prediction:
    """Predicted actions of a network whose weights stay as they are.

    It calls the kernels that the modules call, on tensors of the same shapes, so that its actions
    are those of the modules, bit for bit. Most of the time of a small network goes by between the
    kernels, so here are no modules, no autocast and no dropout. And what depends on no observation
    is computed at the first call for each number of rows: the token of the latent 0, and the
    decoder up to the queries of its first attention to the memory.

    Args:
        model: in evaluation mode; it is on its device before the first prediction.
    """

    def __init__(self, model: ActModel) -> None:
        self._model = model
        self._layers: _Layers | None = None
        self._constants: dict[int, _Constants] = {}

    def __call__(self, state: Tensor, images: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) float32 from (B, 1, S) and (B, 1, N, H, W, 3)."""
        model = self._model
        layers = self._layers = self._layers or _Layers.of(model)
        constants = self._constants.get(len(state))
        if constants is None:
            constants = self._constants[len(state)] = layers.constants(model, len(state))
        state_BS = state[:, -1]
        if model.small_vision is not None:
            state_BS = torch.cat([state_BS, model.small_vision(images)], dim=1)
        for step in layers.state:
            state_BS = step(state_BS)
        tokens, position_MD = [constants.latent, state_BS[:, None]], constants.position
        if model.vision is not None:
            image_tokens, image_positions = model.vision(images)
            tokens.append(image_tokens)
            position_MD = torch.cat([position_MD, image_positions])
        memory_BMD = torch.cat(tokens, dim=1)
        for encoder_layer in layers.encoder:
            memory_BMD = encoder_layer(memory_BMD, position_MD)
        memory_BMD = layers.encoder_norm(memory_BMD)
        key_BMD = memory_BMD + position_MD
        first, *others = layers.decoder
        x_BLD = first.from_memory(constants.tokens, constants.queries, memory_BMD, key_BMD)
        for layer in others:
            x_BLD = layer(x_BLD, constants.query_position, memory_BMD, key_BMD)
        actions = layers.action_head(layers.decoder_norm(x_BLD))
        return actions.view(len(state), -1, layers.action_size)[:, : model.chunk_size]


class _Constants(NamedTuple):
    """What depends on no observation, for B rows.

    Attributes:
        latent: (B, 1, D) token of the latent 0.
        position: (2, D) of the tokens of latent and state.
        query_position: (L, D) learned positions of the decoder's tokens.
        tokens: (B, L, D) of the decoder before its first attention to the memory.
        queries: (B, G, L, E) of these tokens to the memory.
    """

    latent: Tensor
    position: Tensor
    query_position: Tensor
    tokens: Tensor
    queries: Tensor


class _Layers(NamedTuple):
    """Layers of a network as functions."""

    state: list[Step]
    encoder: list[_EncoderLayer]
    encoder_norm: Step
    decoder: list[_DecoderLayer]
    decoder_norm: Step
    action_head: Step
    action_size: int

    @classmethod
    def of(cls, model: ActModel) -> _Layers:
        projection = model.state_projection
        parts = list(projection) if isinstance(projection, nn.Sequential) else [projection]
        layers = model.decoder.layers[: model.decoder.num_run]
        return cls(
            [_function(part) for part in parts],
            [_EncoderLayer(layer) for layer in model.encoder.layers],  # type: ignore[arg-type]
            _function(model.encoder.norm),
            [_DecoderLayer(layer) for layer in layers],  # type: ignore[arg-type]
            _function(model.decoder.norm),
            _function(model.action_head),
            model.action_head.out_features // model.config.actions_per_query,
        )

    def constants(self, model: ActModel, batch: int) -> _Constants:
        query_LD = model.queries
        latent = query_LD.new_zeros((batch, model.config.latent_size))
        x_BLD = query_LD.new_zeros((batch, *query_LD.shape))
        x_BLD = self.decoder[0].among_themselves(x_BLD, query_LD)
        query_BGLE = self.decoder[0].queries(x_BLD, query_LD)
        token_B1D = _function(model.latent_projection)(latent)[:, None]
        return _Constants(token_B1D, model.token_positions, query_LD, x_BLD, query_BGLE)


class _Attention:
    """Attention of ``model.py``, as two steps: projections to heads, and the rest."""

    def __init__(self, layer: Attention) -> None:
        self.query, self.key, self.value = map(_function, (layer.query, layer.key, layer.value))
        self._out, self._num_heads = _function(layer.out), layer.num_heads

    def heads(self, projected_BLD: Tensor) -> Tensor:
        """Return (B, G, L, E)."""
        batch, length, _ = projected_BLD.shape
        return projected_BLD.view(batch, length, self._num_heads, -1).transpose(1, 2)

    def attend(self, query_BGLE: Tensor, key_BMD: Tensor, value_BMD: Tensor) -> Tensor:
        """Return (B, L, D) from queries that are projected, and keys and values that are not."""
        key, value = self.heads(self.key(key_BMD)), self.heads(self.value(value_BMD))
        attended = nn.functional.scaled_dot_product_attention(query_BGLE, key, value)
        return self._out(attended.transpose(1, 2).flatten(2))


class _Residual:
    """Residual connection with its layer normalisation, before or after the block."""

    def __init__(self, layer: Residual) -> None:
        self._pre_norm, self._norm = layer.pre_norm, _function(layer.norm)

    def before(self, x_BLD: Tensor) -> Tensor:
        return self._norm(x_BLD) if self._pre_norm else x_BLD

    def after(self, x_BLD: Tensor, change_BLD: Tensor) -> Tensor:
        x_BLD = x_BLD + change_BLD
        return x_BLD if self._pre_norm else self._norm(x_BLD)


def _feed_forward(layer: FeedForward, residual: Residual) -> Step:
    """Return the feed-forward block of a layer, with its residual connection."""
    widen, narrow, around = _function(layer.widen), _function(layer.narrow), _Residual(residual)

    def compute(x_BLD: Tensor) -> Tensor:
        return around.after(x_BLD, narrow(widen(around.before(x_BLD)).relu_()))

    return compute


class _EncoderLayer:
    """Self-attention, then feed-forward."""

    def __init__(self, layer: EncoderLayer) -> None:
        self._attention = _Attention(layer.attention)
        self._residual = _Residual(layer.attention_residual)
        self._feed_forward = _feed_forward(layer.feed_forward, layer.feed_forward_residual)

    def __call__(self, x_BLD: Tensor, position_LD: Tensor) -> Tensor:
        attention, inner = self._attention, self._residual.before(x_BLD)
        query = inner + position_LD
        found = attention.attend(attention.heads(attention.query(query)), query, inner)
        return self._feed_forward(self._residual.after(x_BLD, found))


class _DecoderLayer:
    """Self-attention of the queries, cross-attention to the memory, feed-forward."""

    def __init__(self, layer: DecoderLayer) -> None:
        self._attention = _Attention(layer.attention)
        self._attention_residual = _Residual(layer.attention_residual)
        self._memory_attention = _Attention(layer.memory_attention)
        self._memory_residual = _Residual(layer.memory_residual)
        self._feed_forward = _feed_forward(layer.feed_forward, layer.feed_forward_residual)

    def __call__(
        self, x_BLD: Tensor, position_LD: Tensor, memory_BMD: Tensor, key_BMD: Tensor
    ) -> Tensor:
        x_BLD = self.among_themselves(x_BLD, position_LD)
        return self.from_memory(x_BLD, self.queries(x_BLD, position_LD), memory_BMD, key_BMD)

    def among_themselves(self, x_BLD: Tensor, position_LD: Tensor) -> Tensor:
        """Return the tokens after their self-attention."""
        attention, inner = self._attention, self._attention_residual.before(x_BLD)
        query = inner + position_LD
        found = attention.attend(attention.heads(attention.query(query)), query, inner)
        return self._attention_residual.after(x_BLD, found)

    def queries(self, x_BLD: Tensor, position_LD: Tensor) -> Tensor:
        """Return the queries (B, G, L, E) of these tokens to the memory."""
        attention, query = self._memory_attention, self._memory_residual.before(x_BLD) + position_LD
        return attention.heads(attention.query(query))

    def from_memory(
        self, x_BLD: Tensor, query_BGLE: Tensor, memory_BMD: Tensor, key_BMD: Tensor
    ) -> Tensor:
        """Return the tokens after cross-attention and feed-forward."""
        found = self._memory_attention.attend(query_BGLE, key_BMD, memory_BMD)
        return self._feed_forward(self._memory_residual.after(x_BLD, found))


def _function(layer: nn.Module) -> Step:
    """Return a layer without parts as a function that casts its input as the layer does."""
    if isinstance(layer, nn.Linear):
        return _product(layer)
    if isinstance(layer, nn.LayerNorm):
        return _norm(layer)
    if isinstance(layer, nn.GELU):
        return nn.functional.gelu
    if isinstance(layer, nn.Identity):
        return lambda x: x
    raise TypeError(f"no function for a {type(layer).__name__}")


def _product(layer: nn.Linear) -> Step:
    weight, bias, dtype = layer.weight, layer.bias, layer.weight.dtype

    def compute(x: Tensor) -> Tensor:
        return nn.functional.linear(x if x.dtype == dtype else x.to(dtype), weight, bias)

    return compute


def _norm(layer: nn.LayerNorm) -> Step:
    shape, weight, bias, eps = layer.normalized_shape, layer.weight, layer.bias, layer.eps

    def compute(x: Tensor) -> Tensor:
        x = x if x.dtype == torch.float32 else x.float()
        return nn.functional.layer_norm(x, shape, weight, bias, eps)

    return compute
