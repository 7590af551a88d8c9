"""Noise is on what the robot feels of itself and on the clock, and on nothing else."""

from __future__ import annotations

import pytest
import torch

from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.training.batching import StateNoise, step_noise

SPEC = ObservationSpec(obs="current_pred", horizon=3, cameras=(), object_pose=True)
NAMES = ObservedNames(objects=("cube",))


def drawn(noise: StateNoise) -> torch.Tensor:
    """(100, 32, S) of a hundred steps."""
    parts = [noise.draw(7, step, 32) for step in range(100)]
    return torch.stack([part for part in parts if part is not None])


def test_it_is_where_it_belongs() -> None:
    added = drawn(StateNoise(SPEC, NAMES, robot=0.3, clock=0.5))
    for index, name in enumerate(SPEC.vector_names(NAMES)):
        expected = 0.3 if index < 14 else 0.5 * name.startswith("t_")
        # 3200 numbers: the deviation strays by 1.25 % of itself; five times that.
        assert added[..., index].std().item() == pytest.approx(expected, rel=0.0625), name
        assert abs(added[..., index].mean().item()) <= 5 * expected / 3200**0.5, name


def test_there_is_one_clock() -> None:
    times = [i for i, name in enumerate(SPEC.vector_names(NAMES)) if name.startswith("t_")]
    shown = drawn(StateNoise(SPEC, NAMES, robot=0.3, clock=0.5))[..., times]
    assert len(times) == 4
    assert torch.equal(shown, shown[..., :1].expand_as(shown))
    assert (drawn(StateNoise(SPEC, NAMES, robot=0.3))[..., times] == 0.0).all()


def test_it_is_a_function_of_seed_and_step() -> None:
    noise, again = StateNoise(SPEC, NAMES, 0.3, 0.5), StateNoise(SPEC, NAMES, 0.3, 0.5)
    first, same = noise.draw(7, 3, 5), again.draw(7, 3, 5)
    assert first is not None
    assert same is not None
    assert torch.equal(first, same)
    for seed, step in ((7, 4), (8, 3)):
        other = noise.draw(seed, step, 5)
        assert other is not None
        assert not torch.equal(first, other)
    assert not torch.equal(step_noise(7, "state", 3, 5, 15), step_noise(7, "noise", 3, 5, 15))


@pytest.mark.parametrize("obs", ["baseline", "current"])
def test_nothing_to_add_is_none(obs: str) -> None:
    spec = ObservationSpec(obs=obs, cameras=())
    assert StateNoise(spec, NAMES).draw(0, 0, 4) is None
    assert StateNoise(spec, NAMES, clock=0.5).draw(0, 0, 4) is None  # no clock is shown
    assert StateNoise(spec, NAMES, robot=0.1).draw(0, 0, 4) is not None
