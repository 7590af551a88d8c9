"""From chunks to actions, against five lines of NumPy over the whole table of predictions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from robo_manip_baselines.policy.execution import (
    ActionBuffer,
    ActionQueue,
    TemporalEnsemble,
    make_action_buffer,
)
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.runs.errors import RequestError

ACTION_SIZE = 2


def ensemble_oracle(chunks: NDArray[np.float32], decay: float) -> NDArray[np.float64]:
    """Average over the table (T, T + K, A): row s holds the chunk predicted at step s."""
    steps, size, _ = chunks.shape
    table = np.full((steps, steps + size, ACTION_SIZE), np.nan)
    for s in range(steps):
        table[s, s : s + size] = chunks[s]
    columns = [table[~np.isnan(table[:, t, 0]), t] for t in range(steps)]  # oldest first
    return np.array([np.average(c, 0, np.exp(-decay * np.arange(len(c)))) for c in columns])


def first_oracle(chunks: NDArray[np.float32], execute: int) -> NDArray[np.float32]:
    steps = len(chunks)
    return np.array([chunks[t - t % execute, t % execute] for t in range(steps)])


@dataclasses.dataclass
class Play:
    """Episodes played one after another in environments, each at a pace of its own."""

    buffer: ActionBuffer
    actions: dict[int, list[NDArray[np.float32]]] = dataclasses.field(default_factory=dict)

    def step(self, env_ids: list[int], chunks: NDArray[np.float32]) -> None:
        numbers = np.array(env_ids)
        needed = self.buffer.steps_to_prediction(numbers) == 0
        for env, action in zip(env_ids, self.buffer.act(numbers, chunks[needed]), strict=True):
            self.actions.setdefault(env, []).append(action)


@st.composite
def turns_of_envs(draw: st.DrawFn) -> tuple[int, list[list[int]]]:
    """Number of environments, and for every turn those that act, in any order."""
    num_envs = draw(st.integers(1, 4))
    some = st.lists(st.integers(0, num_envs - 1), unique=True, min_size=1)
    return num_envs, draw(st.lists(some, min_size=1, max_size=25))


@given(
    schedule=turns_of_envs(),
    size=st.integers(1, 7),
    execute=st.integers(0, 7),
    decay=st.sampled_from([0.01, 0.0, 0.7, -0.3]),
    reset_at=st.integers(0, 25),
    seed=st.integers(0, 99),
)
def test_every_environment_acts_as_if_it_were_alone(
    schedule: tuple[int, list[list[int]]],
    size: int,
    execute: int,
    decay: float,
    reset_at: int,
    seed: int,
) -> None:
    """Execute 0 stands for the ensemble. Environment 0 starts a new episode at ``reset_at``."""
    num_envs, turns = schedule
    execute = min(execute, size)
    execution = ActionExecution(
        temporal_ensemble=execute == 0, ensemble_decay=decay, n_action_steps=max(execute, 1)
    )
    play = Play(make_action_buffer(execution, num_envs, size, ACTION_SIZE))
    rng = np.random.default_rng(seed)
    # Zeros among them: a prediction of zero is a prediction.
    draw = rng.integers(-2, 3, (len(turns), num_envs, size, ACTION_SIZE)).astype(np.float32)
    episodes: list[tuple[int, list[NDArray[np.float32]]]] = [(s, []) for s in range(num_envs)]
    current = dict(enumerate(range(num_envs)))
    expected_of: dict[int, list[int]] = {s: [s] for s in range(num_envs)}
    for turn, acts in enumerate(turns):
        if turn == reset_at:
            play.buffer.reset(np.array([0]))
            episodes.append((0, []))
            current[0] = len(episodes) - 1
            expected_of[0].append(current[0])
        for env in acts:
            episodes[current[env]][1].append(draw[turn, env])
        play.step(acts, draw[turn, acts])
    for env in range(num_envs):
        parts = [np.array(episodes[e][1]) for e in expected_of[env] if episodes[e][1]]
        if not parts:
            continue
        expected = np.concatenate(
            [first_oracle(p, execute) if execute else ensemble_oracle(p, decay) for p in parts]
        )
        # float32 out of float64 sums of at most 7 numbers below 3.
        np.testing.assert_allclose(play.actions[env], expected, rtol=0, atol=1e-6)


def test_the_ensemble_of_two() -> None:
    ensemble = TemporalEnsemble(1, 3, 1, decay=0.5)
    env = np.array([0])
    ensemble.act(env, np.array([[[1.0], [2.0], [3.0]]], np.float32))
    action = ensemble.act(env, np.array([[[0.0], [0.0], [0.0]]], np.float32))
    np.testing.assert_allclose(action, 2.0 / (1.0 + np.exp(-0.5)), rtol=1e-6)


def test_an_episode_knows_nothing_of_the_last_one_in_its_environment() -> None:
    rng = np.random.default_rng(0)
    chunks = rng.normal(size=(2, 5, 4, ACTION_SIZE)).astype(np.float32)
    for execution in (
        ActionExecution(ensemble_decay=0.5),
        ActionExecution(temporal_ensemble=False, n_action_steps=3),
    ):
        used, fresh = (make_action_buffer(execution, 2, 4, ACTION_SIZE) for _ in range(2))
        env = np.array([1])
        for chunk in chunks[0]:
            used.act(env, chunk[None][used.steps_to_prediction(env) == 0])
        used.reset(env)
        for chunk in chunks[1]:
            np.testing.assert_array_equal(
                used.act(env, chunk[None][used.steps_to_prediction(env) == 0]),
                fresh.act(env, chunk[None][fresh.steps_to_prediction(env) == 0]),
            )


def test_the_ensemble_holds_no_table_of_chunks() -> None:
    ensemble = TemporalEnsemble(8, 100, 7)
    numbers = sum(v.size for v in vars(ensemble).values() if isinstance(v, np.ndarray))
    assert numbers <= 8 * 100 * (7 + 1) + 2 * 100


def test_a_chunk_is_asked_for_only_when_the_last_is_used_up() -> None:
    first = ActionQueue(2, 5, 1, n_action_steps=3)
    chunks = np.arange(5, dtype=np.float32).reshape(1, 5, 1)
    needs = []
    for _ in range(7):
        env_ids = np.array([1])
        needs.append(int(first.steps_to_prediction(env_ids)[0]))
        first.act(env_ids, chunks[:0] if needs[-1] else chunks)
    assert needs == [0, 2, 1, 0, 2, 1, 0]
    assert not first.steps_to_prediction(np.array([0])).any()  # it has never acted


@pytest.mark.parametrize("execute", [6, 100])
def test_no_more_than_a_chunk_can_be_carried_out(execute: int) -> None:
    with pytest.raises(RequestError, match=f"n_action_steps {execute}: must be 1 to 5"):
        make_action_buffer(
            ActionExecution(temporal_ensemble=False, n_action_steps=execute), 1, 5, 1
        )
