"""The contract of every registered policy; one of an installed package is covered, too."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pkgutil import resolve_name

import pytest
import torch

from robo_manip_baselines.data.normalization import METHODS
from robo_manip_baselines.policy.execution import TILE
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel
from robo_manip_baselines.policy.registry import (
    make_model,
    policy_entry,
    policy_names,
    policy_presets,
)

BATCH = 5


def dims_of(policy: str, preset: str) -> PolicyDims:
    cameras = len(policy_presets(policy)[preset].cameras)
    return PolicyDims(state=29, action=7, cameras=cameras, image=(64, 96))


def make(policy: str) -> tuple[PolicyModel, PolicyDims]:
    """Build the policy of the preset with the fewest cameras."""
    presets = policy_presets(policy)
    name = min(presets, key=lambda name: len(presets[name].cameras))
    dims = dims_of(policy, name)
    torch.manual_seed(0)
    return make_model(policy, presets[name].config, dims), dims


def make_batch(model: PolicyModel, dims: PolicyDims) -> Batch:
    """(B, ...) examples; the last ones of the chunk are padding in all but the first example."""
    generator = torch.Generator().manual_seed(1)
    chunk, steps = model.chunk_size, model.n_obs_steps
    is_pad = torch.arange(chunk)[None] >= torch.tensor([chunk, *range(1, BATCH)])[:, None]
    shape = (BATCH, steps, dims.cameras, *dims.image, 3)
    images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    return Batch(
        state=torch.randn(BATCH, steps, dims.state, generator=generator),
        images=images if dims.cameras else None,
        action=torch.randn(BATCH, chunk, dims.action, generator=generator),
        is_pad=is_pad,
        noise=torch.randn(BATCH, model.noise_size, generator=generator),
        num_valid=(~is_pad).sum().float(),
        num_examples=torch.tensor(float(BATCH)),
    )


every_policy = pytest.mark.parametrize("policy", policy_names())


@every_policy
def test_presets_make_networks_that_fit(policy: str) -> None:
    entry, presets = policy_entry(policy), policy_presets(policy)
    assert presets
    assert callable(METHODS.get(entry.normalization) or resolve_name(entry.normalization))
    for name, preset in presets.items():
        assert isinstance(preset.config, resolve_name(entry.config))
        with torch.device("meta"):  # without numbers
            model = make_model(policy, preset.config, dims_of(policy, name))
        assert isinstance(model, PolicyModel)
        assert min(model.chunk_size, model.n_obs_steps) >= 1
        assert preset.execution.n_action_steps <= model.chunk_size * preset.training.skip


@every_policy
def test_the_loss_is_finite_and_reaches_every_parameter(policy: str) -> None:
    model, dims = make(policy)
    parts = model.train().loss(make_batch(model, dims))
    for value in parts.values():
        assert value.shape == ()
        assert value.dtype == torch.float32
        assert value.isfinite()
    parts["loss"].backward()
    # Not "nonzero": the biases of attention's keys, for one, cancel in the softmax.
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
    assert [name for name, p in trained.items() if p.grad is None] == []
    assert any(p.grad is not None and p.grad.any() for p in trained.values())
    groups = model.parameter_groups(1e-3)
    assert sum(len(group["params"]) for group in groups) == len(trained)  # pyright: ignore[reportArgumentType]


@every_policy
def test_padding_changes_nothing(policy: str) -> None:
    model, dims = make(policy)
    batch = make_batch(model.eval(), dims)
    other = torch.where(batch.is_pad[..., None], torch.inf, batch.action)
    for name, value in model.loss(batch).items():
        assert torch.equal(value, model.loss(dataclasses.replace(batch, action=other))[name])


@every_policy
def test_a_row_does_not_depend_on_the_others(policy: str) -> None:
    model, dims = make(policy)
    batch = make_batch(model.eval(), dims)
    noise = None
    if model.sample_noise_size:
        generator = torch.Generator().manual_seed(2)
        noise = torch.randn(BATCH, model.sample_noise_size, generator=generator)
    together = model.predict(batch.state, batch.images, noise)
    assert together.shape == (BATCH, model.chunk_size, dims.action)
    assert together.dtype == torch.float32
    row = slice(2, 3)
    alone = model.predict(
        batch.state[row],
        None if batch.images is None else batch.images[row],
        None if noise is None else noise[row],
    )
    # Matrix products of other shapes add up in another order: a few float32 ulps of unit numbers.
    torch.testing.assert_close(together[row], alone, rtol=0, atol=1e-5)


@every_policy
def test_the_place_in_a_tile_changes_no_digit(policy: str) -> None:
    """Or an episode would depend on the environments that run beside it."""
    trained, dims = make(policy)
    model, size = trained.eval().for_inference(torch.float32), trained.sample_noise_size
    generator = torch.Generator().manual_seed(3)
    state = torch.randn(TILE, model.n_obs_steps, dims.state, generator=generator)
    noise = torch.randn(TILE, size, generator=generator) if size else None
    images = None
    if dims.cameras:
        shape = (TILE, model.n_obs_steps, dims.cameras, *dims.image, 3)
        images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    with torch.inference_mode():
        first = model.predict(state, images, noise)
        for places in range(1, TILE):
            rolled = [None if x is None else x.roll(places, 0) for x in (state, images, noise)]
            assert torch.equal(model.predict(*rolled), first.roll(places, 0))  # pyright: ignore[reportArgumentType]


@pytest.mark.long
@every_policy
def test_training_lowers_the_loss_of_a_batch(policy: str) -> None:
    model, dims = make(policy)
    batch = make_batch(model.train(), dims)
    optimizer = torch.optim.AdamW(model.parameter_groups(1e-3), weight_decay=0.0)
    losses = []
    for _ in range(300):
        optimizer.zero_grad()
        loss = model.loss(batch)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


@every_policy
def test_weights_multiply_the_errors_of_their_steps(policy: str) -> None:
    model, dims = make(policy)
    model.eval()  # without dropout
    batch = make_batch(model, dims)

    def error(weight: torch.Tensor | None) -> float:
        parts = model.loss(replace(batch, weight=weight))
        return parts.get("l1", parts["loss"]).item()

    ones = torch.ones(batch.is_pad.shape)
    assert error(None) == error(ones)
    assert error(3.0 * ones) == pytest.approx(3.0 * error(ones), rel=1e-5)
    # What the two halves of the steps contribute adds up.
    chosen = torch.rand(ones.shape, generator=torch.Generator().manual_seed(2)) < 0.5
    halves = error(chosen.float()), error((~chosen).float())
    assert sum(halves) == pytest.approx(error(ones), rel=1e-5)
    assert min(halves) > 0.0
