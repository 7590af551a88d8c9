"""Episodes are the same in any number of environments and processes; failures are reported."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE
from robo_manip_baselines.policy.checkpoint import Checkpoint, load_model
from robo_manip_baselines.policy.execution import PolicyRunner
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.rollout.demonstrate import demonstrate
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.rollout import ActingPolicy, Recording, rollout
from robo_manip_baselines.rollout.workers import (
    EnvConfig,
    EnvPool,
    StepRequest,
    WorkerEnvs,
    open_envs,
)
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

SEEDS = [1004, 1000, 1007, 1001, 1003]
FIRST = ActionExecution(temporal_ensemble=False, n_action_steps=4)


@pytest.fixture(scope="module")
def checkpoint(
    make_checkpoint: Callable[[Path], Checkpoint], tmp_path_factory: pytest.TempPathFactory
) -> Checkpoint:
    return make_checkpoint(tmp_path_factory.mktemp("run") / "checkpoint")


class Recurrent:
    """Remembers its observations in each environment: a mistake about those shows at once."""

    def __init__(self, num_envs: int) -> None:
        self.memory = np.zeros((num_envs, 7))

    def reset(self, env_ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        self.memory[env_ids] = 0.0

    def needs_images(self, env_ids: NDArray[np.intp]) -> NDArray[np.bool_]:
        return np.zeros(len(env_ids), np.bool_)

    def act(
        self,
        vectors: NDArray[np.float32],
        images: NDArray[np.uint8] | None,
        env_ids: NDArray[np.intp],
    ) -> NDArray[np.float32]:
        self.memory[env_ids] = 0.9 * self.memory[env_ids] + 0.01 * vectors[:, :7]
        return (vectors[:, :7] + self.memory[env_ids]).astype(np.float32)


Played = tuple[list[EpisodeResult], dict[int, Recording]]


def play(policy: ActingPolicy, envs: EnvPool, seeds: list[int]) -> Played:
    recordings: dict[int, Recording] = {}
    results = rollout(
        policy, envs, seeds, on_episode=lambda r, rec: recordings.update({r.seed: rec})
    )
    assert [result.seed for result in results] == seeds
    assert set(recordings) == set(seeds)
    return results, recordings


def network(checkpoint: Checkpoint, execution: ActionExecution, num_envs: int) -> PolicyRunner:
    model, spec = load_model(checkpoint), checkpoint.spec
    return PolicyRunner(model, spec, checkpoint.normalization, execution, num_envs=num_envs)


POLICIES: dict[str, Callable[[Checkpoint, int], ActingPolicy]] = {
    "recurrent": lambda _, num_envs: Recurrent(num_envs),
    "ensemble": lambda checkpoint, num_envs: network(checkpoint, ActionExecution(), num_envs),
    "first": lambda checkpoint, num_envs: network(checkpoint, FIRST, num_envs),
}


@pytest.fixture(scope="module")
def alone(env_config: EnvConfig, checkpoint: Checkpoint) -> dict[str, Played]:
    """Every episode on its own, in an environment of its own."""
    played: dict[str, Played] = {}
    for name, make in POLICIES.items():
        results, recordings = [], {}
        for seed in SEEDS:
            with open_envs(env_config, 1, 0) as envs:
                one, recording = play(make(checkpoint, 1), envs, [seed])
            results += one
            recordings |= recording
        played[name] = results, recordings
    return played


@pytest.mark.parametrize("workers", [0, 1, 2])
@pytest.mark.parametrize("num_envs", [1, 3, 8])
def test_an_episode_depends_on_its_seed_alone(
    env_config: EnvConfig,
    checkpoint: Checkpoint,
    alone: dict[str, Played],
    num_envs: int,
    workers: int,
) -> None:
    """Bit for bit: what was seen and done at every step, and what it came to."""
    with open_envs(env_config, num_envs, workers) as envs:
        for name, make in POLICIES.items():
            results, recordings = play(make(checkpoint, num_envs), envs, SEEDS)
            expected, recorded = alone[name]
            assert results == expected
            for seed in SEEDS:
                assert len(recordings[seed].actions) == results[0].steps == 30
                np.testing.assert_array_equal(recordings[seed].actions, recorded[seed].actions)
                np.testing.assert_array_equal(recordings[seed].vectors, recorded[seed].vectors)
    assert multiprocessing.active_children() == []


def test_episodes_differ(alone: dict[str, Played]) -> None:
    """Else the test above would say nothing."""
    for _, recordings in alone.values():
        ends = [tuple(recording.vectors[-1]) for recording in recordings.values()]
        assert len(set(ends)) == len(SEEDS)


def test_a_demonstration_acted_out_again_is_the_success_that_it_was(env_config: EnvConfig) -> None:
    full = replace(env_config, env_kwargs={})
    with full.make() as env:
        shown = demonstrate(env, "reactive", 2, codec="raw", quality=90)

    class Replay(Recurrent):
        step = 0

        def act(self, *_: Any) -> NDArray[np.float32]:
            self.step += 1
            return shown.arrays["action"][self.step - 1 : self.step].astype(np.float32)

    with open_envs(full, 1, 0) as envs:
        (result,) = rollout(Replay(1), envs, [2])
    truth = shown.attributes
    assert (result.is_success, result.failure) == (True, "")
    assert result.is_success == truth["is_success"]
    assert (result.motion_clip, result.motion_subject) == (
        truth["motion_clip"],
        truth["motion_subject"],
    )
    # Actions are float32 here and float64 there: a condition may be met a step later.
    assert result.steps == pytest.approx(len(shown.arrays["time"]), abs=2)
    assert result.completion_time == pytest.approx(truth["completion_time"], abs=0.03)
    mouth, gripper = shown.arrays["mouth_position"][:, 0], shown.arrays["end_effector_position"]
    carried = shown.arrays["phase"] >= 2
    nearest = np.linalg.norm(gripper - mouth, axis=1)[carried].min()
    columns = result.columns
    assert columns["closest_distance"] <= nearest + 1e-3  # m; the last row is one step earlier
    assert columns["closest_distance"] == pytest.approx(nearest, abs=2e-3)
    assert (np.abs(columns["closest_offset"]) < MOUTH_TOLERANCE).all()
    cube = shown.arrays["object_pose"][:, :3]
    nearest = np.linalg.norm(cube - mouth, axis=1)[carried].min()
    assert np.linalg.norm(columns["cube_offset"]) == pytest.approx(nearest, abs=2e-3)


@pytest.mark.gl
def test_only_what_the_policy_needs_is_rendered(env_config: EnvConfig) -> None:
    """Images are those of the environment, in shared memory too; in between none is drawn."""
    spec = replace(env_config.spec, cameras=("front_close", "top"), image_size=(24, 32))
    seen = replace(env_config, spec=spec)
    with seen.make(cameras=spec.cameras) as env:
        truth = [env.reset(seed=5)[0]]
        action = env.action_space.low
        truth += [env.step(action)[0] for _ in range(3)]
    for workers in (0, 1):
        with open_envs(seen, 2, workers) as envs:
            images, number = envs.arrays["images"], 1
            envs.arrays["actions"][number] = action
            requests = [
                StepRequest(number, 5, True),
                *[StepRequest(number, None, needed) for needed in (True, False, True)],
            ]
            for request, observation in zip(requests, truth, strict=True):
                images[:] = 7
                envs.submit([request])
                assert envs.wait() == [(number, None)]
                assert (images[0] == 7).all()
                if request.needs_images:
                    np.testing.assert_array_equal(
                        images[number, 0], observation["images/front_close"]
                    )
                    np.testing.assert_array_equal(images[number, 1], observation["images/top"])
                else:
                    assert (images[number] == 7).all()


def test_a_worker_that_dies_is_an_error_and_not_a_hang(env_config: EnvConfig) -> None:
    class Murderer(Recurrent):
        def act(self, *arguments: Any) -> NDArray[np.float32]:
            assert isinstance(envs, WorkerEnvs)
            os.kill(envs._workers[1].process.pid, signal.SIGKILL)
            return super().act(*arguments)

    with (
        open_envs(env_config, 4, 2) as envs,
        pytest.raises(
            RuntimeError, match=r"worker process of environments 1, 3 died \(exit code -9\)"
        ),
    ):
        rollout(Murderer(4), envs, range(8))
    assert multiprocessing.active_children() == []


def test_what_goes_wrong_in_a_worker_is_reported(env_config: EnvConfig) -> None:
    class Lost(Recurrent):
        def act(self, *arguments: Any) -> NDArray[np.float32]:
            return super().act(*arguments) * np.nan

    with (
        open_envs(env_config, 1, 1) as envs,
        pytest.raises(RuntimeError, match=r"(?s)worker process failed:.*finite numbers"),
    ):
        rollout(Lost(1), envs, [0])
    wrong = replace(env_config, env_kwargs={"clips": ("me",)})
    with open_envs(wrong, 1, 1) as envs, pytest.raises(RequestError, match="unknown clip 'me'"):
        rollout(Recurrent(1), envs, [0])
    assert multiprocessing.active_children() == []


def test_numbers_that_make_no_sense_are_refused(env_config: EnvConfig) -> None:
    for num_envs, workers, message in ((0, 0, "num_envs 0"), (1, -1, "workers -1")):
        with pytest.raises(RequestError, match=message), open_envs(env_config, num_envs, workers):
            pass
    with (
        open_envs(env_config, 1, 0) as envs,
        pytest.raises(ValueError, match="every seed may be there once"),
    ):
        rollout(Recurrent(1), envs, [1, 1])


def test_no_seeds_no_episodes(env_config: EnvConfig) -> None:
    with open_envs(env_config, 2, 0) as envs:
        assert rollout(Recurrent(2), envs, []) == []


class Seeing(PolicyModel):
    """Every pixel and every number of the state makes a difference to its actions."""

    chunk_size = 4

    def predict(
        self, state: torch.Tensor, images: torch.Tensor | None, noise: torch.Tensor | None
    ) -> torch.Tensor:
        assert images is not None
        seen = images[:, -1].float().flatten(1) / 255
        weight = torch.linspace(-1, 1, seen.shape[1])
        glance = (seen * weight).mean(1) + 0.01 * state[:, -1].sum(1)
        return glance[:, None, None] * torch.linspace(-1, 1, 28).view(4, 7)


@pytest.mark.gl
def test_a_network_that_sees_acts_the_same_in_any_arrangement(env_config: EnvConfig) -> None:
    """Images through shared memory; some steps without any."""
    spec = replace(env_config.spec, cameras=("front_close", "top"), image_size=(32, 40))
    seen = replace(env_config, spec=spec, env_kwargs={"max_episode_steps": 7})
    ones, zeros = np.ones(seen.vector_size, np.float32), np.zeros(seen.vector_size, np.float32)
    scale = Normalization(zeros, ones, zeros[:7], ones[:7])
    played = []
    for execution in (ActionExecution(), FIRST):
        for num_envs, workers in ((1, 0), (3, 2)):
            policy = PolicyRunner(Seeing(), spec, scale, execution, num_envs=num_envs)
            with open_envs(seen, num_envs, workers) as envs:
                _, recordings = play(policy, envs, SEEDS)
            played.append(np.array([recordings[seed].actions for seed in SEEDS]))
    np.testing.assert_array_equal(played[0], played[1])
    np.testing.assert_array_equal(played[2], played[3])
    assert not np.array_equal(played[0], played[2])
