"""One recorded dataset serves every preset: what a file holds gives what the environment showed."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path
from robo_manip_baselines.evaluation.episode_replay import remake_env
from robo_manip_baselines.expert.collect import Collection, collect
from robo_manip_baselines.observation import ObservationSpec, Truth, observe

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    collect(Collection("FeedingEnv", folder, "reactive", range(4, 5), {"cameras": ()}))
    return episode_path(folder, 4, success=True)


def truth_of(episode: EpisodeReader) -> Truth:
    """(T, ...) truth of a recorded episode of one arm."""
    return Truth(
        time=episode.array("time"),
        joint_position=episode.array("joint_position")[:, None],
        joint_velocity=episode.array("joint_velocity")[:, None],
        gripper_position=episode.array("gripper_position"),
        gripper_velocity=episode.array("gripper_velocity"),
        end_effector_position=episode.array("end_effector_position"),
        mouth_position=episode.array("mouth_position"),
        object_position=episode.array("object_pose")[:, :3],
    )


@pytest.mark.parametrize(
    "spec",
    [
        ObservationSpec(obs="baseline", cameras=()),
        ObservationSpec(obs="current", cameras=(), object_pose=True),
        ObservationSpec(obs="current_pred", horizon=1, cameras=()),
        ObservationSpec(obs="current_pred", horizon=5, cameras=(), object_pose=True),
    ],
)
def test_a_file_read_with_a_preset_is_what_the_environment_shows(
    recorded: Path, spec: ObservationSpec
) -> None:
    with (
        EpisodeReader(recorded) as episode,
        closing(
            remake_env(episode, obs=spec.obs, horizon=spec.horizon, object_pose=spec.object_pose)
        ) as env,
    ):
        read = observe(spec, truth_of(episode))
        shown, _ = env.reset(seed=episode.attributes["seed"])
        for step, action in enumerate(episode.array("action")):
            for key, value in shown.items():
                # Sums of squares may be added up in another order for a batch: one float32 ulp.
                np.testing.assert_allclose(read[key][step], value, rtol=3e-7, err_msg=key)
            shown, *_ = env.step(action)
