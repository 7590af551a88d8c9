"""Encoded and skipped actions in training and in use, for every policy alike."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.actions import ActionEncoding
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.observation.arm import gripper_position
from robo_manip_baselines.policy.checkpoint import load_model, read_checkpoint
from robo_manip_baselines.policy.execution import PolicyRunner, interpolated
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.batching import BatchLoader, StateNoise
from robo_manip_baselines.training.setup import TrainSetup
from robo_manip_baselines.training.trainer import train

POLICIES = {
    "Act": "--chunk_size 4 --hidden_size 8 --feedforward_size 8 --num_heads 2",
    "Mlp": "--chunk_size 4 --hidden_size 8",
    "Sarnn": "--chunk_size 4 --hidden_size 8 --n_obs_steps 3",
    "Diffusion": "--chunk_size 4 --hidden_size 16 --num_layers 1",
    "Flow": "--chunk_size 4 --hidden_size 16 --num_layers 1",
    "Flow with a camera": "--chunk_size 4 --hidden_size 16 --num_layers 1 --cameras top "
    "--image_size 24x32 --keypoints 4",
}
MOUTH = "--mouth_frame both --mouth_time forecast --horizon 3 --relative"


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes whose postures and actions are regular."""
    folder, rng = tmp_path_factory.mktemp("episodes"), np.random.default_rng(0)
    for seed, steps in enumerate((12, 9, 15, 11)):
        arrays = make_arrays(steps, seed)
        low, high = [-0.5, -0.6, 0.2, -1, -0.8, -1, 0.02], [0.5, 0.2, 1.0, 1, 0.8, 1, 0.06]
        arrays["action"] = rng.uniform(low, high, (steps, 7))
        arrays["joint_position"] = arrays["action"][:, :6] + 0.01
        path = episode_path(folder, seed, success=True)
        images = make_images(steps, cameras=("top",))
        write_episode(path, arrays, images, make_attributes(seed))
    return folder


def configure(line: str, episodes: Path, out: Path) -> Any:
    args = f"{line} --preset cpu --batch_size 4 --steps 2 --logger none --dataset {episodes}"
    return parse_config([*args.split(), "--out", str(out)], has_gpu=False)


@pytest.mark.parametrize("policy", list(POLICIES))
@pytest.mark.long
def test_every_policy_learns_them_and_its_checkpoint_says_so(
    policy: str, episodes: Path, tmp_path: Path
) -> None:
    line = f"{policy.split()[0]} {POLICIES[policy]} {MOUTH} --skip 2"
    assert train(configure(line, episodes, tmp_path / "run")) == 0
    checkpoint = read_checkpoint(tmp_path / "run")
    assert (checkpoint.spec.mouth_frame, checkpoint.spec.mouth_time) == ("both", "forecast")
    assert checkpoint.encoding == ActionEncoding(checkpoint.spec, 0.04)
    assert checkpoint.settings.skip == 2
    facts = checkpoint.spec, checkpoint.normalization, ActionExecution()
    coding: Any = {"encoding": checkpoint.encoding, "skip": 2}
    runner = PolicyRunner(load_model(checkpoint), *facts, **coding, num_envs=2)
    runner.reset(np.arange(2), [0, 1])
    vectors = np.zeros((2, checkpoint.dims.state), np.float32)
    images = np.zeros((2, 1, 24, 32, 3), np.uint8) if checkpoint.dims.cameras else None
    assert np.isfinite(runner.act(vectors, images, np.arange(2))).all()


@pytest.mark.parametrize(
    ("options", "noise"), [(MOUTH, 0.0), ("--relative_actions", 0.3), (f"{MOUTH} --skip 3", 0.3)]
)
def test_a_batch_is_what_the_encoding_makes_of_its_chunks(
    options: str, noise: float, episodes: Path, tmp_path: Path
) -> None:
    config = configure(f"Mlp {POLICIES['Mlp']} {options} --state_noise {noise}", episodes, tmp_path)
    setup, skip = TrainSetup.load(config), config.training.skip
    given, scale = setup.demonstrations, setup.normalization
    loader = BatchLoader(
        *(given, scale, range(4), setup.sampler, setup.make_model()),
        seed=0,
        device="cpu",
        encoding=setup.encoding,
        skip=skip,
    )
    batch = loader.batch(0)
    for row, (episode, start) in enumerate(setup.sampler.batch(0)):
        first, last = given.offsets[episode], given.offsets[episode + 1] - 1
        chunk = [min(first + start + k * skip, last) for k in range(4)]
        vector = given.state[first + start]
        encoded = setup.encoding.encode(given.action[chunk], vector)
        expected = (encoded - scale.action_mean) / scale.action_std
        np.testing.assert_allclose(batch.action[row], expected, atol=1e-4)  # float32, over a std


def test_noise_moves_the_posture_that_actions_are_relative_to(
    episodes: Path, tmp_path: Path
) -> None:
    """So that the target stays where the demonstration went."""
    config = configure(f"Mlp {POLICIES['Mlp']} --relative_actions", episodes, tmp_path)
    setup = TrainSetup.load(config)
    spec, scale = setup.demonstrations.spec, setup.normalization
    noise = StateNoise(spec, ObservedNames(objects=("cube",)), robot=0.5)
    batch = BatchLoader(
        *(setup.demonstrations, scale, range(4), setup.sampler, setup.make_model()),
        seed=0,
        device="cpu",
        encoding=setup.encoding,
        state_noise=noise,
    ).batch(0)
    shown = batch.state[:, -1].numpy() * scale.state_std + scale.state_mean
    found = setup.encoding.decode(scale.unnormalize_action(batch.action.numpy()), shown)
    for row, (episode, start) in enumerate(setup.sampler.batch(0)):
        first = setup.demonstrations.offsets[episode]
        action = setup.demonstrations.action[first + start]
        np.testing.assert_allclose(found[row, 0], action, atol=1e-5)  # float32


def test_noise_on_actions_is_normal_and_a_function_of_seed_and_step(
    episodes: Path, tmp_path: Path
) -> None:
    setup = TrainSetup.load(configure(f"Mlp {POLICIES['Mlp']}", episodes, tmp_path))

    def actions(step: int, noise: float, **changes: Any) -> np.ndarray:
        given = setup.demonstrations, setup.normalization, range(4), setup.sampler
        settings = {"seed": 3, "device": "cpu", **changes}
        loader = BatchLoader(*given, setup.make_model(), action_noise=noise, **settings)
        return loader.batch(step).action.numpy()

    added = np.stack([actions(step, 0.2) - actions(step, 0.0) for step in range(40)])
    # 4480 numbers: the deviation strays by 1 % of itself; five times that.
    assert added.std() == pytest.approx(0.2, rel=0.05)
    assert abs(added.mean()) < 5 * 0.2 / 4480**0.5
    np.testing.assert_array_equal(actions(7, 0.2), actions(7, 0.2))
    assert (actions(7, 0.2) != actions(7, 0.2, seed=4)).any()
    halves = [actions(7, 0.2, rank=rank, world_size=2) for rank in range(2)]
    np.testing.assert_array_equal(np.concatenate(halves), actions(7, 0.2))


def test_what_cannot_be_encoded_is_refused(episodes: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="relative to one thing"):
        configure(f"Mlp {MOUTH} --relative_actions", episodes, tmp_path)
    with EpisodeReader(episode_path(episodes, 0, success=True)) as episode:
        steps = len(episode)
    arrays = make_arrays(steps, 0)
    arrays["action"] = np.tile([0, 0, -1.7, 0, 0, 0, 0.02], (steps, 1))
    write_episode(
        episode_path(tmp_path / "bent", 0, success=True),
        *(arrays, make_images(steps), make_attributes(0)),
    )
    config = configure(f"Mlp {MOUTH} --validation_fraction 0", tmp_path / "bent", tmp_path / "run")
    with pytest.raises(RequestError, match="the right arm is stretched"):
        TrainSetup.load(config)


SPEC = ObservationSpec("current_pred", 3, cameras=(), mouth_frame="actions")
SIZE = len(SPEC.vector_names(ObservedNames()))
ONES = Normalization(
    *(np.full(n, v, np.float32) for n, v in ((SIZE, 0), (SIZE, 1), (7, 0), (7, 1)))
)


class Still(PolicyModel):
    """Always 2 cm in front of the mouth, a little farther with each action."""

    chunk_size = 4
    strategies = ("rtc",)

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        self.shown = state.clone()
        chunk = torch.zeros(len(state), 4, 7)
        chunk[..., 0] = 0.02 + 0.01 * torch.arange(4)
        return chunk

    def inpaint(
        self,
        state: Tensor,
        images: Tensor | None,
        noise: Tensor | None,
        action: Tensor,
        weight: Tensor,
    ) -> Tensor:
        self.under_way = action
        return self.predict(state, images, noise)


def vectors(mouth: float) -> np.ndarray:
    """A mouth at that height, (1, S)."""
    vector = np.zeros((1, SIZE), np.float32)
    start = SPEC.vector_names(ObservedNames()).index("x_0")
    for k in range(4):
        vector[0, start + 4 * k : start + 4 * k + 3] = (0.0, 0.5, mouth)
    return vector


def test_the_gripper_goes_to_the_mouth_wherever_it_is() -> None:
    execution = ActionExecution(temporal_ensemble=False, n_action_steps=2)
    model, encoding = Still(), ActionEncoding(SPEC, 0.02)
    runner = PolicyRunner(model, SPEC, ONES, execution, encoding=encoding, num_envs=1)
    runner.reset(np.arange(1), [0])
    for step, mouth in enumerate((0.3, 0.4, 0.35, 0.2)):
        action = runner.act(vectors(mouth), None, np.arange(1))
        # A chunk goes where the mouth was when it was predicted.
        height, ahead = (0.3, 0.3, 0.35, 0.35)[step], 0.02 + 0.01 * (step % 2)
        expected = [[ahead, 0.5, height]]
        np.testing.assert_allclose(gripper_position("right", action[:, :6]), expected, atol=1e-6)


def test_the_chunk_under_way_is_told_from_the_mouth_of_the_next_one() -> None:
    execution = ActionExecution(
        temporal_ensemble=False, n_action_steps=2, strategy="rtc", inference_delay=1
    )
    model, encoding = Still(), ActionEncoding(SPEC, 0.02)
    runner = PolicyRunner(model, SPEC, ONES, execution, encoding=encoding, num_envs=1)
    runner.reset(np.arange(1), [0])
    for mouth in (0.3, 0.3, 0.38):
        runner.act(vectors(mouth), None, np.arange(1))
    # Its second action, 3 cm in front of a mouth that is 8 cm higher now.
    np.testing.assert_allclose(model.under_way[0, 0, :3].numpy(), [0.03, 0.0, -0.08], atol=1e-5)


def test_skipped_steps_are_interpolated_and_not_shown() -> None:
    chunks = np.array([[[0.0], [1.0], [3.0]]], np.float32)
    np.testing.assert_allclose(interpolated(chunks, 2)[0, :, 0], [0, 0.5, 1, 2, 3, 3])

    class Two(Still):
        n_obs_steps = 2

    spec = ObservationSpec("current_pred", 3, cameras=())
    execution = ActionExecution(temporal_ensemble=False, n_action_steps=8)
    model = Two()
    runner = PolicyRunner(model, spec, ONES, execution, skip=3, num_envs=1)
    runner.reset(np.arange(1), [0])
    executed = []
    for step in range(9):
        vector = np.full((1, SIZE), step, np.float32)
        executed.append(runner.act(vector, None, np.arange(1))[0, 0])
    # 0.02, 0.03, 0.04, 0.05 with two targets between each pair, and the next chunk after eight.
    expected = [*(0.02 + 0.01 * np.arange(8) / 3), 0.02]
    np.testing.assert_allclose(executed, expected, rtol=1e-5)
    np.testing.assert_array_equal(model.shown[0, :, 0].numpy(), [5, 8])
