"""Learning rates, AdamW and the moving average against slow and obvious ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.mlp.model import MlpModel
from robo_manip_baselines.policy.presets import PolicyDims, TrainSettings
from robo_manip_baselines.training.state import (
    WeightAverage,
    learning_rate_factor,
    make_optimizer,
    set_learning_rate,
)

DIMS = PolicyDims(state=3, action=2, cameras=0, image=(1, 1))


def make_model() -> MlpModel:
    torch.manual_seed(0)
    return MlpModel(MlpConfig(chunk_size=2, hidden_size=4, hidden_layers=1), DIMS)


@pytest.mark.parametrize(
    ("schedule", "warmup", "total", "expected"),
    [
        ("constant", 0, 4, [1.0, 1.0, 1.0, 1.0]),
        ("constant", 3, 5, [0.25, 0.5, 0.75, 1.0, 1.0]),
        # cos of 0, 45, 90 and 135 degrees
        ("cosine", 0, 4, [1.0, 0.5 + math.sqrt(0.125), 0.5, 0.5 - math.sqrt(0.125)]),
        ("cosine", 1, 3, [0.5, 1.0, 0.5]),
        ("cosine", 9, 3, [0.1, 0.2, 0.3]),  # a budget that ends within the warm-up
    ],
)
def test_learning_rate_factors(
    schedule: str, warmup: int, total: int, expected: list[float]
) -> None:
    settings = TrainSettings(schedule=schedule, warmup_steps=warmup, steps=total)
    factors = [learning_rate_factor(step, total, settings) for step in range(total)]
    assert factors == pytest.approx(expected, abs=1e-12)  # rounding of float64


@given(st.integers(1, 500), st.integers(0, 600), st.sampled_from(["constant", "cosine"]))
def test_every_step_learns(total: int, warmup: int, schedule: str) -> None:
    settings = TrainSettings(schedule=schedule, warmup_steps=warmup, steps=total)
    factors = [learning_rate_factor(step, total, settings) for step in range(total)]
    assert all(0.0 < factor <= 1.0 for factor in factors)


def test_each_group_keeps_its_own_rate() -> None:
    model = make_model()
    first, *rest = model.parameters()

    def groups(rate: float) -> list[dict[str, object]]:
        return [{"params": [first], "lr": rate / 10}, {"params": rest, "lr": rate}]

    model.parameter_groups = groups  # type: ignore[method-assign]
    optimizer = make_optimizer(model, TrainSettings(learning_rate=0.5, steps=1))
    set_learning_rate(optimizer, 0.5)
    set_learning_rate(optimizer, 0.25)  # of the first rate, not of the last one
    assert [group["lr"] for group in optimizer.param_groups] == pytest.approx([0.0125, 0.125])


def test_the_optimizer_is_adamw() -> None:
    model = make_model()
    weights = {k: v.detach().double().numpy().copy() for k, v in model.named_parameters()}
    settings = TrainSettings(learning_rate=0.01, weight_decay=0.1, steps=3)
    optimizer = make_optimizer(model, settings)
    moments = {name: (np.zeros(w.shape), np.zeros(w.shape)) for name, w in weights.items()}
    rng = np.random.default_rng(0)
    for step in range(1, 4):
        for name, parameter in model.named_parameters():
            gradient = rng.normal(size=parameter.shape)
            parameter.grad = torch.tensor(gradient, dtype=torch.float32)
            mean, square = moments[name]
            mean += 0.1 * (gradient - mean)
            square += 0.001 * (gradient**2 - square)
            weights[name] *= 1 - 0.01 * 0.1
            unbiased = mean / (1 - 0.9**step), square / (1 - 0.999**step)
            weights[name] -= 0.01 * unbiased[0] / (np.sqrt(unbiased[1]) + 1e-8)
        optimizer.step()
    for name, parameter in model.named_parameters():
        # float32 keeps seven digits of weights that are below 1
        np.testing.assert_allclose(parameter.detach().numpy(), weights[name], atol=1e-6)


def test_the_average_is_the_recursion_with_its_warm_up() -> None:
    model = make_model()
    average = WeightAverage(model, decay=0.5)
    expected = [p.detach().double().numpy().copy() for p in model.parameters()]
    for step in range(12):
        for number, parameter in enumerate(model.parameters()):
            parameter.data += 0.1 * (number + 1)
            decay = min(0.5, (1 + step) / (10 + step))
            now = parameter.detach().double().numpy()
            expected[number] = decay * expected[number] + (1 - decay) * now
        average.update(step)
    for parameter, value in zip(average.model.parameters(), expected, strict=True):
        np.testing.assert_allclose(parameter.numpy(), value, rtol=1e-5)  # twelve roundings
        assert not parameter.requires_grad
