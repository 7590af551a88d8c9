"""Dropout: how many are dropped, what becomes of the others, and that the draws are independent."""

from __future__ import annotations

import pytest
import torch

from robo_manip_baselines.policy.act.model import Dropout

COUNT = 1_000_003  # no multiple of 4


def dropped(probability: float, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    torch.manual_seed(seed)
    return Dropout(probability)(torch.ones(COUNT, dtype=dtype))


@pytest.mark.parametrize("probability", [0.01, 0.1, 0.5, 0.9])
def test_as_many_are_dropped_as_asked_and_the_mean_stays(probability: float):
    found = dropped(probability)
    # Five standard deviations of a binomial share.
    tolerance = 5 * (probability * (1 - probability) / COUNT) ** 0.5
    assert (found == 0).double().mean().item() == pytest.approx(probability, abs=tolerance)
    assert found.double().mean().item() == pytest.approx(1.0, abs=tolerance / (1 - probability))
    # One value for all that stay: that of the probability, which is met to 1 in 65,536.
    assert found.unique().tolist() == pytest.approx([0.0, 1 / (1 - probability)], rel=1e-3)


def test_neighbours_and_the_parts_of_a_draw_are_independent():
    zeros = (dropped(0.5) == 0).double() - 0.5
    for lag in (1, 2, 3, 4, 5, 8, 64):
        correlation = 4 * (zeros[lag:] * zeros[:-lag]).mean().item()
        assert abs(correlation) < 5 / COUNT**0.5
    for part in range(4):
        assert abs(2 * zeros[part::4].mean().item()) < 5 / (COUNT / 4) ** 0.5


def test_the_seed_decides():
    assert torch.equal(dropped(0.1), dropped(0.1))
    assert not torch.equal(dropped(0.1), dropped(0.1, seed=1))


def test_the_gradient_is_the_same_factor():
    torch.manual_seed(0)
    x = torch.linspace(1.0, 2.0, 1000).reshape(10, 10, 10).requires_grad_()
    found = Dropout(0.3)(x)
    found.sum().backward()
    assert x.grad is not None
    assert torch.equal(found, x * x.grad)


def test_the_type_stays():
    assert dropped(0.1, dtype=torch.bfloat16).dtype == torch.bfloat16


@pytest.mark.parametrize("layer", [Dropout(0.0), Dropout(0.5).eval()])
def test_there_is_none_in_evaluation_or_without_a_probability(layer: Dropout):
    x = torch.ones(1000)
    assert torch.equal(layer(x), x)
