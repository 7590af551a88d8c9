"""What every registered policy must do; a new one is covered by its line in the registry."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import torch

from robo_manip_baselines.policy.interface import Batch, PolicyModel
from robo_manip_baselines.policy.presets import PolicyPreset, PolicyDims
from robo_manip_baselines.policy.registry import POLICIES, load_part, make_model

DIMS = PolicyDims(state=29, action=7, cameras=0, image=(480, 640))
CHUNK = 6


def presets_of(policy: str) -> dict[str, PolicyPreset]:
    return load_part(POLICIES[policy].presets)


def make(policy: str) -> PolicyModel:
    """Build the policy of the preset ``cpu``, with a short chunk."""
    torch.manual_seed(0)
    config = dataclasses.replace(presets_of(policy)["cpu"].config, chunk_size=CHUNK)
    return make_model(policy, config, DIMS)


def make_batch(model: PolicyModel, size: int = 5) -> Batch:
    """(B, ...) examples; the last ones of the chunk are padding in all but the first example."""
    generator = torch.Generator().manual_seed(1)
    is_pad = torch.arange(CHUNK)[None] >= torch.tensor([CHUNK, *range(1, size)])[:, None]
    return Batch(
        state=torch.randn(size, DIMS.state, generator=generator),
        images=None,
        action=torch.randn(size, CHUNK, DIMS.action, generator=generator),
        is_pad=is_pad,
        noise=torch.randn(size, model.noise_size, generator=generator),
        num_valid=(~is_pad).sum().float(),
        num_examples=torch.tensor(float(size)),
    )


every_policy = pytest.mark.parametrize("policy", sorted(POLICIES))


@every_policy
def test_presets_make_networks_that_fit(policy: str) -> None:
    presets = presets_of(policy)
    assert presets.keys() <= {"cpu", "paper"}
    assert "cpu" in presets
    for preset in presets.values():
        assert preset.acting.execute <= preset.config.chunk_size


@every_policy
def test_the_loss_is_finite_and_reaches_every_parameter(policy: str) -> None:
    model = make(policy).train()
    parts = model.loss(make_batch(model))
    for value in parts.values():
        assert value.shape == ()
        assert value.dtype == torch.float32
        assert value.isfinite()
    parts["loss"].backward()
    # Not "nonzero": the biases of attention's keys, for one, cancel in the softmax.
    assert [n for n, p in model.named_parameters() if p.grad is None] == []
    assert sum(bool(p.grad is not None and p.grad.any()) for p in model.parameters()) > 5
    groups = model.parameter_groups(1e-3)
    assert sum(len(group["params"]) for group in groups) == len(list(model.parameters()))  # pyright: ignore[reportArgumentType]


@every_policy
def test_padding_changes_nothing(policy: str) -> None:
    model = make(policy).eval()
    batch = make_batch(model)
    other = torch.where(batch.is_pad[..., None], torch.inf, batch.action)
    for name, value in model.loss(batch).items():
        assert torch.equal(value, model.loss(dataclasses.replace(batch, action=other))[name])


@every_policy
def test_a_row_does_not_depend_on_the_others(policy: str) -> None:
    model = make(policy).eval()
    state = make_batch(model).state
    together = model.predict(state, None)
    assert together.shape == (len(state), CHUNK, DIMS.action)
    assert together.dtype == torch.float32
    # Matrix products of other shapes add up in another order: a few float32 ulps of unit numbers.
    torch.testing.assert_close(together[2:3], model.predict(state[2:3], None), rtol=0, atol=1e-5)


@pytest.mark.long
@every_policy
def test_a_batch_can_be_learnt_by_heart(policy: str) -> None:
    model = make(policy).train()
    batch = make_batch(model)
    optimizer = torch.optim.AdamW(model.parameter_groups(1e-3), weight_decay=0.0)
    first = float(model.loss(batch)["l1"].detach())
    for _ in range(300):
        optimizer.zero_grad()
        model.loss(batch)["loss"].backward()
        optimizer.step()
    with torch.no_grad():
        error = (model.eval().predict(batch.state, None) - batch.action).abs()
    assert float(error[~batch.is_pad].mean()) < 0.5 * first


def test_the_page_on_adding_a_policy_names_what_there_is(repository: Path) -> None:
    page = (repository / "docs/policies.md").read_text(encoding="utf-8")
    members = re.findall(r"^\| `(\w+)", page, flags=re.MULTILINE)
    assert set(members) >= {"chunk_size", "noise_size", "loss", "predict", "parameter_groups"}
    assert all(
        hasattr(PolicyModel, name) or name in PolicyModel.__annotations__ for name in members
    )
