"""Chunks that come late: which action of which chunk is executed when, and what a policy is shown.

A timeline is a word for every control step: ``hold``, or chunk and action as ``1.3``, the chunks
being counted from 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.diffusion.config import DiffusionConfig
from robo_manip_baselines.policy.execution import (
    ActionQueue,
    PolicyRunner,
    make_action_buffer,
    soft_weights,
)
from robo_manip_baselines.policy.flow.config import FlowConfig
from robo_manip_baselines.policy.interface import PolicyDims, PolicyModel
from robo_manip_baselines.policy.presets import STRATEGIES, ActionExecution
from robo_manip_baselines.policy.registry import make_model
from robo_manip_baselines.runs.errors import RequestError

CHUNK = 8


def execution(strategy: str, n_action_steps: int = 3, delay: int = 0) -> ActionExecution:
    if strategy == "ensemble":
        return ActionExecution(inference_delay=delay)
    return ActionExecution(
        temporal_ensemble=False,
        n_action_steps=n_action_steps,
        strategy=strategy,
        inference_delay=delay,
    )


def timeline(settings: ActionExecution, steps: int) -> tuple[list[str], list[int]]:
    """Words of an episode, and the steps at which a chunk was asked for."""
    buffer = make_action_buffer(settings, 2, CHUNK, 1)
    env, held, asked, words = np.array([1]), np.full((1, 1), -1.0, np.float32), [], []
    for step in range(steps):
        chunks = np.empty((0, CHUNK, 1), np.float32)
        if buffer.steps_to_prediction(env)[0] == 0:
            chunks = (10 * len(asked) + np.arange(CHUNK)).reshape(1, CHUNK, 1).astype(np.float32)
            asked.append(step)
        action = round(float(buffer.act(env, chunks, held)[0, 0]))
        words.append("hold" if action < 0 else f"{action // 10}.{action % 10}")
    return words, asked


@pytest.mark.parametrize(
    ("strategy", "delay", "expected", "asked"),
    [
        ("synchronous", 0, "0.0 0.1 0.2 1.0 1.1 1.2 2.0", [0, 3, 6]),
        ("naive", 0, "0.0 0.1 0.2 1.0 1.1 1.2 2.0", [0, 3, 6]),
        ("synchronous", 2, "hold hold 0.0 0.1 0.2 hold hold 1.0 1.1 1.2 hold", [0, 5, 10]),
        ("naive", 2, "hold hold 0.0 0.1 0.2 1.2 1.3 1.4 2.2 2.3", [0, 3, 6, 9]),
        ("rtc", 2, "hold hold 0.0 0.1 0.2 1.2 1.3 1.4 2.2 2.3", [0, 3, 6, 9]),
        ("roll_forward", 2, "hold hold 0.0 0.1 0.2 1.0 1.1 1.2 2.0 2.1", [0, 3, 6, 9]),
        ("naive", 3, "hold hold hold 0.0 0.1 0.2 1.3 1.4 1.5 2.3", [0, 3, 6, 9]),
    ],
)
def test_timelines(strategy: str, delay: int, expected: str, asked: list[int]) -> None:
    words = expected.split()
    assert timeline(execution(strategy, 3, delay), len(words)) == (words, asked)


@pytest.mark.parametrize(
    ("n_action_steps", "delay"), [(s, d) for s in range(1, 6) for d in range(min(s, 3) + 1)]
)
def test_actions_are_those_of_the_latest_chunk_that_is_there(
    n_action_steps: int, delay: int
) -> None:
    """Chunk i is asked for at i S and there at i S + D; it says what to do at i S + its number."""
    words, asked = timeline(execution("naive", n_action_steps, delay), 30)
    assert asked == list(range(0, 30, n_action_steps))
    for step in range(delay + n_action_steps, 30):  # the first chunk is not cut
        number = (step - delay) // n_action_steps
        assert words[step] == f"{number}.{step - number * n_action_steps}"


def test_a_late_ensemble_averages_what_is_there() -> None:
    delay, rng = 2, np.random.default_rng(0)
    chunks = rng.normal(size=(12, CHUNK)).astype(np.float32)
    buffer = make_action_buffer(ActionExecution(inference_delay=delay), 1, CHUNK, 1)
    held = np.full((1, 1), 9.0, np.float32)
    for step in range(12):
        action = buffer.act(np.array([0]), chunks[step].reshape(1, CHUNK, 1), held)[0, 0]
        there = [s for s in range(step - delay + 1) if step - s < CHUNK]
        weights = np.exp(-0.01 * np.arange(len(there)))
        values = [chunks[s, step - s] for s in there]
        # float32 of a float64 sum of numbers of about 1
        expected = np.average(values, weights=weights) if there else 9.0
        assert action == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (execution("naive", 7, 2), "n_action_steps 7: must be 1 to 6, the chunk size less the 2"),
        (execution("roll_forward", 9, 2), "n_action_steps 9: must be 1 to 8, the chunk size$"),
        (execution("rtc", 2, 3), "inference_delay 3: must be at most n_action_steps 2"),
        (execution("ensemble", delay=8), "inference_delay 8: must be less than 8"),
    ],
)
def test_what_does_not_fit_is_one_line(settings: ActionExecution, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        make_action_buffer(settings, 1, CHUNK, 1)


def test_an_unknown_strategy_is_named() -> None:
    with pytest.raises(RequestError, match=r"unknown strategy 'fast'; valid: .*naive.*synchronous"):
        execution("fast")


def test_executions_read_back_and_old_ones_too() -> None:
    for strategy in STRATEGIES:
        for delay in (0, 2):
            settings = execution(strategy, delay=delay)
            assert ActionExecution.from_json(settings.to_json()) == settings
            assert settings.name == strategy
    old = {"temporal_ensemble": False, "decay": 0.01, "execute": 3}
    assert execution("synchronous").to_json() == old
    assert ActionExecution.from_json(old) == execution("synchronous")


def test_soft_weights_are_those_of_real_time_chunking() -> None:
    (weights,) = soft_weights(10, 2, np.array([7]))
    c = (7 - np.arange(2, 7)) / (7 - 2 + 1)
    expected = [1.0, 1.0, *(c * (np.exp(c) - 1) / (np.e - 1)), 0.0, 0.0, 0.0]
    np.testing.assert_allclose(weights, expected, rtol=1e-6)
    assert not soft_weights(10, 2, np.array([0])).any()


def test_a_chunk_under_way() -> None:
    queue = ActionQueue(1, 5, 1, n_action_steps=2, delay=1, waits=False, first=1)
    env, held = np.array([0]), np.zeros((1, 1), np.float32)
    assert queue.under_way(env)[1] == 0
    chunk = np.arange(5, dtype=np.float32).reshape(1, 5, 1)
    for given in (chunk, chunk[:0]):
        queue.act(env, given, held)
    actions, left = queue.under_way(env)  # action 0 has been executed
    assert (actions.ravel().tolist(), left.tolist()) == ([1, 2, 3, 4, 4], [4])


# -- policies -------------------------------------------------------------------------------------

SPEC = ObservationSpec(obs="current", cameras=())
SIZE = len(SPEC.vector_names(ObservedNames()))
POSTURE = SPEC.posture_places


def normalization() -> Normalization:
    rng = np.random.default_rng(0)
    return Normalization(*(rng.uniform(0.5, 2.0, n).astype(np.float32) for n in (SIZE, SIZE, 7, 7)))


def observe(seed: int, step: int) -> NDArray[np.float32]:
    return np.random.default_rng([seed, step]).normal(size=(1, SIZE)).astype(np.float32)


class Watched(PolicyModel):
    """Remembers what it was shown; the action k of its n-th chunk is 100 n + k."""

    chunk_size, n_obs_steps = CHUNK, 2
    strategies, max_delay = ("rtc", "rtc_trained"), 2

    def __init__(self) -> None:
        super().__init__()
        self.states: list[NDArray[np.float32]] = []
        self.chunks: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        self.states.append(state.numpy().copy())
        steps = torch.arange(CHUNK).float() + 100 * (len(self.states) - 1)
        return steps[None, :, None].expand(1, CHUNK, 7)

    def inpaint(self, *given: Any) -> Tensor:
        self.chunks.append((given[3].numpy().copy(), given[4].numpy().copy()))
        return self.predict(*given[:3])

    extend = inpaint


def play(settings: ActionExecution, steps: int) -> tuple[Watched, list[NDArray[np.float32]]]:
    model, env = Watched(), np.array([0])
    runner = PolicyRunner(model, SPEC, normalization(), settings, num_envs=1, tile=1)
    runner.reset(env, [7])
    return model, [runner.act(observe(7, step), None, env)[0] for step in range(steps)]


def test_the_robot_holds_its_posture_and_then_its_last_target() -> None:
    _, actions = play(execution("synchronous", 3, 2), 9)
    posture = observe(7, 0)[0, POSTURE]
    names = SPEC.vector_names(ObservedNames())
    assert [names[place] for place in POSTURE][:2] == [
        "right/waist position",
        "right/shoulder position",
    ]
    assert names[POSTURE[-1]] == "right/gripper position"
    for step in (0, 1):
        np.testing.assert_allclose(actions[step], posture, rtol=1e-5, atol=1e-5)
    for step in (5, 6):
        np.testing.assert_array_equal(actions[step], actions[4])


def test_joints_are_shown_where_their_targets_will_be() -> None:
    """Targets go on by 1 each step, the delay is 2; only the joints change, in every step shown."""
    scale = normalization()
    model, _ = play(execution("roll_forward", 3, 2), 7)
    shown, plain = model.states, play(execution("naive", 3, 2), 7)[0].states
    np.testing.assert_array_equal(shown[0], plain[0])  # nothing was under way
    change = np.zeros_like(plain[1])
    change[..., POSTURE] = 2 * scale.action_std / scale.state_std[POSTURE]
    np.testing.assert_allclose(shown[1], plain[1] + change, rtol=1e-5, atol=1e-5)


def test_what_goes_on_is_told_to_the_network() -> None:
    """The first action of the chunk under way is the one that comes next."""
    for strategy in ("rtc", "rtc_trained"):
        model, _ = play(execution(strategy, 3, 2), 7)
        assert not model.chunks[0][1].any()
        for number, next_action in ((1, 1), (2, 103)):
            actions, weights = model.chunks[number]
            left = CHUNK - next_action % 100
            np.testing.assert_allclose(
                actions[0, :left, 0], next_action + np.arange(left), rtol=1e-6
            )
            assert weights[0, :2].tolist() == [1, 1]
            assert weights[0, 2:].any() == (strategy == "rtc")


def test_without_a_delay_strategies_agree() -> None:
    expected = play(execution("synchronous", 3), 12)[1]
    for strategy in ("naive", "roll_forward", "rtc_trained"):
        np.testing.assert_array_equal(play(execution(strategy, 3), 12)[1], expected)


def test_strategies_that_a_policy_lacks_are_named() -> None:
    class Plain(Watched):
        strategies = ()

    def runner(model: PolicyModel, settings: ActionExecution) -> PolicyRunner:
        return PolicyRunner(model, SPEC, normalization(), settings, num_envs=1)

    message = "strategy 'rtc': not with Plain; valid: synchronous, naive, ensemble, roll_forward"
    with pytest.raises(RequestError, match=message):
        runner(Plain(), execution("rtc", 3, 2))
    with pytest.raises(RequestError, match="rtc_trained is learnt with --max_prefix"):
        runner(Plain(), execution("rtc_trained", 3, 2))
    with pytest.raises(RequestError, match="inference_delay 3: must be at most the max_prefix 2"):
        runner(Watched(), execution("rtc_trained", 3, 3))


SMALL: dict[str, Any] = {
    "chunk_size": CHUNK,
    "channels": (8, 16),
    "hidden_size": 16,
    "sampling_steps": 3,
}


@pytest.mark.parametrize(
    ("policy", "strategy"),
    [
        *(("Flow", strategy) for strategy in STRATEGIES),
        *(("Diffusion", strategy) for strategy in STRATEGIES if strategy != "rtc_trained"),
    ],
)
def test_actions_do_not_depend_on_the_environments_beside_them(policy: str, strategy: str) -> None:
    """Bit for bit; Diffusion draws noise on the way, too."""
    config = FlowConfig(**SMALL, max_prefix=2) if policy == "Flow" else None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        model = make_model(
            policy,
            config or DiffusionConfig(**SMALL, eta=0.7),
            PolicyDims(state=SIZE, action=7, cameras=0, image=(8, 8)),
        )

    def runner(num_envs: int) -> PolicyRunner:
        settings = execution(strategy, 3, 2)
        return PolicyRunner(model, SPEC, normalization(), settings, num_envs=num_envs)

    many, alone, envs = runner(4), runner(1), np.array([3, 0, 2])
    many.reset(envs, [5, 6, 7])
    alone.reset(np.array([0]), [6])
    actions = []
    for step in range(7):
        seen = np.concatenate([observe(seed, step) for seed in (5, 6, 7)])
        together = many.act(seen, None, envs)
        single = alone.act(seen[1:2], None, np.array([0]))
        np.testing.assert_array_equal(together[1:2], single)
        actions.append(single)
    assert len(np.unique(np.concatenate(actions)[:, 0])) > 3
