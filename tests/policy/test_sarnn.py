"""The recurrent policy: what it remembers, of whom, and what it predicts beside actions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.execution import PolicyRunner
from robo_manip_baselines.policy.interface import Batch, PolicyDims
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.policy.registry import make_model, policy_presets
from robo_manip_baselines.policy.sarnn.config import SarnnConfig
from robo_manip_baselines.policy.sarnn.model import SarnnModel

SPEC = ObservationSpec("current", cameras=())
SIZE = len(SPEC.vector_names(ObservedNames()))
STEPS = 5


def make(**changes: float) -> SarnnModel:
    config = replace(SarnnConfig(chunk_size=3, n_obs_steps=STEPS, hidden_size=16), **changes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        return SarnnModel(config, PolicyDims(SIZE, 7, 0, (32, 40))).eval()


def test_every_observation_of_the_window_is_remembered_in_its_order() -> None:
    model = make()
    state = torch.randn(1, STEPS, SIZE, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        before = model.predict(state, None, None)
        for step in range(STEPS):
            other = state.clone()
            other[:, step] += 1.0
            assert not torch.allclose(model.predict(other, None, None), before, atol=1e-6)
        assert not torch.allclose(model.predict(state.flip(1), None, None), before, atol=1e-4)


def test_the_hidden_state_is_that_of_a_loop() -> None:
    """Cell by cell, from zeros."""
    model = make()
    state = torch.randn(2, STEPS, SIZE, generator=torch.Generator().manual_seed(1))
    weights = [getattr(model.memory, f"{kind}_l0") for kind in ("weight_ih", "weight_hh")]
    biases = [getattr(model.memory, f"{kind}_l0") for kind in ("bias_ih", "bias_hh")]
    with torch.no_grad():
        hidden, cell = torch.zeros(2, 16), torch.zeros(2, 16)
        for step in range(STEPS):
            seen = model.encoder(state[:, step])
            gates = seen @ weights[0].T + hidden @ weights[1].T + biases[0] + biases[1]
            enter, forget, new, leave = gates.chunk(4, dim=1)
            cell = forget.sigmoid() * cell + enter.sigmoid() * new.tanh()
            hidden = leave.sigmoid() * cell.tanh()
        found = model.predict(state, None, None)
        torch.testing.assert_close(found, model.chunk(hidden), rtol=0, atol=1e-5)  # float32


def test_the_loss_predicts_the_next_observation() -> None:
    model = make(prediction_weight=0.5)
    generator = torch.Generator().manual_seed(2)
    is_pad = torch.zeros(4, 3, dtype=torch.bool)
    batch = Batch(
        state=torch.randn(4, STEPS, SIZE, generator=generator),
        images=None,
        action=torch.randn(4, 3, 7, generator=generator),
        is_pad=is_pad,
        noise=torch.zeros(4, 0),
        num_valid=torch.tensor(12.0),
        num_examples=torch.tensor(4.0),
    )
    parts = model.loss(batch)
    assert model.next is not None
    hidden, _ = model.memory(model.encoder(batch.state))
    errors = [
        (model.next(hidden[:, step]) - batch.state[:, step + 1]).square().mean()
        for step in range(STEPS - 1)
    ]
    torch.testing.assert_close(parts["prediction"], torch.stack(errors).mean())
    torch.testing.assert_close(parts["loss"], parts["l1"] + 0.5 * parts["prediction"])
    assert make(prediction_weight=0.0).loss(batch).keys() == {"loss", "l1"}


def test_an_episode_knows_nothing_of_the_one_before_nor_of_its_neighbours() -> None:
    scale = Normalization(
        *(np.full(n, v, np.float32) for n, v in ((SIZE, 0), (SIZE, 1), (7, 0), (7, 1)))
    )

    def runner(num_envs: int) -> PolicyRunner:
        return PolicyRunner(make(), SPEC, scale, ActionExecution(), num_envs=num_envs)

    def act(policy: PolicyRunner, env_ids: list[int], seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        actions = []
        for _ in range(7):
            vectors = rng.normal(size=(1, SIZE)).astype(np.float32).repeat(len(env_ids), axis=0)
            vectors[1:] += 1.0  # neighbours see something else
            actions.append(policy.act(vectors, None, np.array(env_ids))[0])
        return np.array(actions)

    used, alone = runner(3), runner(1)
    used.reset(np.array([2, 0]), [1, 2])
    act(used, [2, 0], seed=1)
    used.reset(np.array([2]), [9])
    alone.reset(np.array([0]), [9])
    np.testing.assert_array_equal(act(used, [2, 0], seed=3), act(alone, [0], seed=3))


COUNTS = {"paper": 90_605, "cpu": 385_775, "cpu_images": 253_143}


@pytest.mark.parametrize("preset", COUNTS)
def test_parameters_of_the_presets(preset: str) -> None:
    chosen = policy_presets("Sarnn")[preset]
    dims = PolicyDims(29, 7, len(chosen.cameras), chosen.image_size)
    with torch.device("meta"):
        model = make_model("Sarnn", chosen.config, dims)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert count == COUNTS[preset]
    assert chosen.config.num_parameters(dims) == pytest.approx(count, rel=0.05)
