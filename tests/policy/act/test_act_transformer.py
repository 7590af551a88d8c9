"""Attention against an explicit softmax, layers against PyTorch's own."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.model import (
    Attention,
    Decoder,
    DecoderLayer,
    Encoder,
    EncoderLayer,
    LayerNorm,
    Linear,
)

ROUNDING = 2e-6  # fp32: sums of up to 24 products of numbers near 1, through a few layers


def config(**settings: object) -> ActConfig:
    plain = {"hidden_size": 16, "feedforward_size": 24, "num_heads": 4, "dropout": 0.0}
    return ActConfig(**{**plain, **settings})  # type: ignore[arg-type]


def randomize(module: nn.Module) -> None:
    """Draw every parameter, biases and norms too: what starts at 0 or 1 hides mistakes."""
    generator = torch.Generator().manual_seed(3)
    for parameter in module.parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape, generator=generator)


def draw(*shape: int, seed: int = 5) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def softmax_attention(
    attention: Attention, query: Tensor, key: Tensor, value: Tensor, keep: Tensor
) -> np.ndarray:
    """The definition, head by head and example by example, in float64."""

    def project(layer: nn.Linear, x: Tensor) -> np.ndarray:
        weight, bias = layer.weight.detach().double(), layer.bias.detach().double()
        return (x.double() @ weight.T + bias).numpy()

    q, k, v = (
        project(attention.query, query),
        project(attention.key, key),
        project(attention.value, value),
    )
    result = np.zeros(q.shape)
    size = q.shape[-1] // attention.num_heads
    for b in range(len(q)):
        for head in range(attention.num_heads):
            part = np.s_[b, :, head * size : (head + 1) * size]
            weight = np.exp(q[part] @ k[part].T / np.sqrt(size)) * keep[b].numpy()
            result[part] = weight / weight.sum(axis=1, keepdims=True) @ v[part]
    return project(attention.out, torch.from_numpy(result))


@pytest.mark.parametrize("masked", [False, True])
def test_attention_is_a_softmax(masked: bool):
    attention = Attention(16, 4)
    randomize(attention)
    query, key, value = draw(3, 5, 16), draw(3, 7, 16, seed=6), draw(3, 7, 16, seed=7)
    keep = torch.arange(7)[None] < torch.tensor([[7], [1], [4]])
    if not masked:
        keep = torch.ones_like(keep)
    found = attention(query, key, value, keep if masked else None)
    expected = softmax_attention(attention, query, key, value, keep)
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=ROUNDING)


def test_what_is_masked_changes_nothing():
    attention = Attention(16, 4)
    keep = torch.arange(7)[None] < torch.tensor([[4], [4]])
    tokens = draw(2, 7, 16)
    other = torch.where(keep[..., None], tokens, 1e3)
    query = draw(2, 5, 16, seed=6)
    assert torch.equal(attention(query, tokens, tokens, keep), attention(query, other, other, keep))


def copy_attention(source: Attention, target: nn.MultiheadAttention) -> None:
    parts = (source.query, source.key, source.value)
    target.in_proj_weight.data = torch.cat([part.weight.data for part in parts])
    target.in_proj_bias.data = torch.cat([part.bias.data for part in parts])
    target.out_proj.load_state_dict(source.out.state_dict())


def copy_feed_forward(source: EncoderLayer | DecoderLayer, target: nn.Module) -> None:
    cast("nn.Linear", target.linear1).load_state_dict(source.feed_forward.widen.state_dict())
    cast("nn.Linear", target.linear2).load_state_dict(source.feed_forward.narrow.state_dict())


@pytest.mark.parametrize("pre_norm", [False, True])
def test_an_encoder_layer_is_pytorchs(pre_norm: bool):
    layer = EncoderLayer(config(pre_norm=pre_norm))
    randomize(layer)
    theirs = nn.TransformerEncoderLayer(
        16, 4, 24, dropout=0.0, batch_first=True, norm_first=pre_norm
    )
    copy_attention(layer.attention, theirs.self_attn)
    copy_feed_forward(layer, theirs)
    theirs.norm1.load_state_dict(layer.attention_residual.norm.state_dict())
    theirs.norm2.load_state_dict(layer.feed_forward_residual.norm.state_dict())
    tokens = draw(2, 6, 16)
    keep = torch.arange(6)[None] < torch.tensor([[6], [3]])
    expected = theirs(tokens, src_key_padding_mask=~keep)
    torch.testing.assert_close(
        layer(tokens, torch.zeros(6, 16), keep), expected, atol=ROUNDING, rtol=1e-5
    )


@pytest.mark.parametrize("pre_norm", [False, True])
def test_a_decoder_layer_is_pytorchs(pre_norm: bool):
    layer = DecoderLayer(config(pre_norm=pre_norm))
    randomize(layer)
    theirs = nn.TransformerDecoderLayer(
        16, 4, 24, dropout=0.0, batch_first=True, norm_first=pre_norm
    )
    copy_attention(layer.attention, theirs.self_attn)
    copy_attention(layer.memory_attention, theirs.multihead_attn)
    copy_feed_forward(layer, theirs)
    theirs.norm1.load_state_dict(layer.attention_residual.norm.state_dict())
    theirs.norm2.load_state_dict(layer.memory_residual.norm.state_dict())
    theirs.norm3.load_state_dict(layer.feed_forward_residual.norm.state_dict())
    tokens, memory = draw(2, 6, 16), draw(2, 9, 16, seed=6)
    torch.testing.assert_close(
        layer(tokens, torch.zeros(6, 16), memory, memory),
        theirs(tokens, memory),
        atol=ROUNDING,
        rtol=1e-5,
    )


def test_positions_join_queries_and_keys_but_not_values():
    layer = EncoderLayer(config())
    randomize(layer)
    tokens, places = draw(2, 6, 16), draw(6, 16, seed=6)
    attended = layer.attention(tokens + places, tokens + places, tokens)
    x = layer.attention_residual.norm(tokens + attended)
    expected = layer.feed_forward_residual.norm(x + layer.feed_forward(x))
    torch.testing.assert_close(layer(tokens, places, None), expected)


def test_positions_join_the_keys_of_the_memory_but_not_its_values():
    layer = DecoderLayer(config())
    randomize(layer)
    tokens, queries = draw(2, 6, 16), draw(6, 16, seed=6)
    memory, placed = draw(2, 9, 16, seed=7), draw(2, 9, 16, seed=8)
    attended = layer.attention(tokens + queries, tokens + queries, tokens)
    x = layer.attention_residual.norm(tokens + attended)
    x = layer.memory_residual.norm(x + layer.memory_attention(x + queries, placed, memory))
    expected = layer.feed_forward_residual.norm(x + layer.feed_forward(x))
    torch.testing.assert_close(layer(tokens, queries, memory, placed), expected)


def test_the_decoder_knows_its_places_and_those_of_the_memory():
    decoder = Decoder(config(), 2, 2)
    randomize(decoder)
    queries, memory, places = draw(6, 16), draw(2, 9, 16, seed=6), draw(9, 16, seed=7)
    x = torch.zeros(2, 6, 16)
    for layer in decoder.layers:
        x = layer(x, queries, memory, memory + places)
    torch.testing.assert_close(decoder(queries, memory, places), decoder.norm(x))
    shuffled = decoder(queries.flip(0), memory, places)
    torch.testing.assert_close(
        shuffled, decoder(queries, memory, places).flip(1), atol=ROUNDING, rtol=1e-5
    )


def test_layers_that_are_not_run_change_nothing_and_are_not_trained():
    decoder = Decoder(config(), 3, 1)
    arguments = draw(6, 16), draw(2, 9, 16, seed=6), draw(9, 16, seed=7)
    before = decoder(*arguments)
    randomize(cast("nn.Module", decoder.layers[1:]))
    assert torch.equal(decoder(*arguments), before)
    assert [next(layer.parameters()).requires_grad for layer in decoder.layers] == [
        True,
        False,
        False,
    ]


def test_between_the_blocks_tokens_are_fp32_and_the_products_are_not():
    encoder = Encoder(config(), 1)
    types: dict[str, torch.dtype] = {}
    for name, module in encoder.named_modules():
        if isinstance(module, Linear | LayerNorm):
            module.register_forward_hook(
                lambda _module, _given, result, name=name: types.update({name: result.dtype})
            )
    with torch.autocast("cpu", torch.bfloat16):
        assert encoder(draw(2, 6, 16), torch.zeros(6, 16)).dtype == torch.float32
    assert {name: kind for name, kind in types.items() if "norm" in name} == {
        "layers.0.attention_residual.norm": torch.float32,
        "layers.0.feed_forward_residual.norm": torch.float32,
    }
    assert {kind for name, kind in types.items() if "norm" not in name} == {torch.bfloat16}


def test_dropout_works_in_training_only():
    encoder = Encoder(config(dropout=0.5), 1)
    tokens, places = draw(2, 6, 16), torch.zeros(6, 16)
    assert not torch.equal(encoder(tokens, places), encoder(tokens, places))
    encoder.eval()
    assert torch.equal(encoder(tokens, places), encoder(tokens, places))


@pytest.mark.parametrize("part", ["attention_residual", "feed_forward", "feed_forward_residual"])
def test_each_dropout_is_there(part: str):
    layer = EncoderLayer(config(dropout=0.5)).eval()
    layer.get_submodule(f"{part}.dropout").train()
    tokens, places = draw(2, 6, 16), torch.zeros(6, 16)
    torch.manual_seed(0)
    assert not torch.equal(layer(tokens, places, None), layer(tokens, places, None))


def test_initial_matrices_are_xaviers_and_biases_nothing():
    decoder = Decoder(config(hidden_size=64), 2, 2)
    for layer in decoder.modules():
        if isinstance(layer, nn.Linear):
            bound = (6.0 / (layer.in_features + layer.out_features)) ** 0.5
            largest = layer.weight.abs().max().item()
            assert 0.9 * bound < largest <= bound  # of more than 1000 draws
            assert not layer.bias.any()
