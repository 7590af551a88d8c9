"""Error bounds of bf16; equality of the model and its copy for inference."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from robo_manip_baselines.policy.interface import PolicyDims

BLIND = PolicyDims(state=5, action=3, cameras=0, image=(40, 70))


def test_under_autocast_both_ends_keep_their_digits(make_model):
    model = make_model(BLIND)
    layers = (model.state_projection, model.action_head, model.cvae.action_projection)
    for layer in layers:
        x = torch.randn(4, layer.in_features, generator=torch.Generator().manual_seed(1))
        exact = layer(x)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(layer(x), exact)
    lean = model.for_inference(torch.bfloat16)
    assert lean.action_head.weight.dtype == torch.float32
    assert lean.encoder.layers[0].feed_forward.widen.weight.dtype == torch.bfloat16


def test_under_autocast_losses_and_actions_are_fp32(make_model, make_batch):
    model, batch = make_model(), make_batch()
    exact = model.loss(batch)
    with torch.autocast("cpu", torch.bfloat16):
        losses = model.loss(batch)
        actions = model.predict(batch.state, batch.images, None)
    assert {value.dtype for value in losses.values()} | {actions.dtype} == {torch.float32}
    for name, value in losses.items():
        # bf16 has 8 bits: 0.4 % a product, some of which adds up over the layers.
        assert value.item() == pytest.approx(exact[name].item(), rel=0.05)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.bfloat16, 0.05)])
@pytest.mark.parametrize("cameras", [0, 2])
def test_the_copy_for_inference_predicts_the_same(
    make_model, make_batch, dtype: torch.dtype, tolerance: float, cameras: int
):
    dims = PolicyDims(5, 3, cameras, (40, 70))
    model, batch = make_model(dims, dropout=0.1).train(), make_batch(dims)
    state = {name: value.clone() for name, value in model.state_dict().items()}
    copied = model.for_inference(dtype)
    assert model.training
    found = copied.predict(batch.state, batch.images, None)
    assert found.dtype == torch.float32
    expected = model.eval().predict(batch.state, batch.images, None)
    scale = expected.abs().max().item()
    torch.testing.assert_close(found, expected, rtol=0.0, atol=tolerance * scale)
    assert not any(p.requires_grad for p in copied.parameters())
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in state.items())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(
    ("cameras", "settings"),
    [
        (0, {}),
        (0, {"state_layers": 2, "actions_per_query": 4, "use_cvae": False, "decoder_layers": 1}),
        (0, {"pre_norm": True, "paper_compat": True}),
        (2, {"pre_norm": True}),
        (2, {"vision": "small", "state_layers": 1}),
    ],
)
def test_without_modules_a_prediction_is_the_same_bit_for_bit(
    make_model, make_batch, cameras: int, settings: dict[str, Any], dtype: torch.dtype
):
    dims = PolicyDims(5, 3, cameras, (40, 70))
    copied, batch = make_model(dims, **settings).for_inference(dtype), make_batch(dims)
    shown = [
        (batch.state[:rows] + shift, None if batch.images is None else batch.images[:rows])
        for rows, shift in ((3, 0.0), (3, 1.0), (2, 0.0), (3, 2.0))
    ]
    found = [copied.predict(*observed, None) for observed in shown]
    assert not torch.equal(found[0], found[1])
    copied.prediction = None  # through the modules
    for observed, actions in zip(shown, found, strict=True):
        assert torch.equal(copied.predict(*observed, None), actions)
