"""One recorded dataset serves every preset: what a file holds gives what the environment showed."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.demonstrations import recorded_state
from robo_manip_baselines.data.example import make_arrays, make_attributes
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.rollout.demonstrate import Collection, collect, remake_env

from .conftest import NAMES, observe


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    collect(Collection("FeedingEnv", folder, "reactive", range(4, 5), {"cameras": ()}))
    return episode_path(folder, 4, success=True)


@pytest.mark.long
@pytest.mark.parametrize(
    "spec",
    [
        ObservationSpec(obs="baseline", cameras=()),
        ObservationSpec(obs="current", cameras=(), object_pose=True),
        ObservationSpec(obs="history", cameras=(), object_pose=True),
        ObservationSpec(obs="current_pred", horizon=1, cameras=()),
        ObservationSpec(obs="current_pred", horizon=5, cameras=(), object_pose=True),
        ObservationSpec(obs="current_pred", horizon=24, cameras=()),
    ],
)
def test_a_file_read_with_a_preset_is_what_the_environment_shows(
    recorded: Path, spec: ObservationSpec
) -> None:
    kwargs = {"obs": spec.obs, "horizon": spec.horizon, "object_pose": spec.object_pose}
    with EpisodeReader(recorded) as episode, closing(remake_env(episode, **kwargs)) as env:
        state, seed = recorded_state(episode), episode.attributes["seed"]
        pipeline = spec.make_pipeline()
        target = pipeline.observe_episode(state, seed) if pipeline else None
        read = observe(spec, state, target)
        shown, _ = env.reset(seed=seed)
        for step, action in enumerate(episode.array("action")):
            for key, value in shown.items():
                # Sums of squares may be added up in another order for a batch: one float32 ulp.
                np.testing.assert_allclose(read[key][step], value, rtol=3e-7, err_msg=key)
            shown, *_ = env.step(action)


def test_two_arms_are_told_apart(tmp_path: Path) -> None:
    arrays = make_arrays(steps=5, arms=2)
    path = write_episode(tmp_path / "a.hdf5", arrays, {}, make_attributes(arms=2))
    spec = ObservationSpec(arms="both", cameras=())
    with EpisodeReader(path) as episode:
        truth = recorded_state(episode)
    assert truth.joint_position.shape == truth.joint_velocity.shape == (5, 2, 6)
    assert truth.gripper_position.shape == (5, 2)
    names = spec.components(NAMES)["state"]
    state = dict(zip(names, observe(spec, truth)["state"].T, strict=True))
    for arm, first in (("left", 0), ("right", 6)):
        for field in ("position", "velocity"):
            waist = arrays[f"joint_{field}"][:, first].astype(np.float32)
            wrist = arrays[f"joint_{field}"][:, first + 5].astype(np.float32)
            gripper = arrays[f"gripper_{field}"][:, first // 6].astype(np.float32)
            np.testing.assert_array_equal(state[f"{arm}/waist {field}"], waist)
            np.testing.assert_array_equal(state[f"{arm}/wrist_rotate {field}"], wrist)
            np.testing.assert_array_equal(state[f"{arm}/gripper {field}"], gripper)
