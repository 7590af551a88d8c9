"""Videos of policies: the choice of episodes, and what is drawn in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.rollout import Recording
from robo_manip_baselines.rollout.videos import CYAN, _dots, pick_for_video, video_name, write_video
from robo_manip_baselines.rollout.workers import EnvConfig

MISS = EpisodeResult(
    env="FeedingEnv",
    seed=0,
    is_success=False,
    is_success_strict=False,
    completion_time=None,
    steps=4,
    failure="never_grasped",
    motion_clip="clip",
    motion_subject="person",
    policy="Mlp",
)


def results(good: list[int], bad: list[int]) -> list[EpisodeResult]:
    hits = [replace(MISS, seed=seed, is_success=True, failure="") for seed in good]
    return [*(replace(MISS, seed=seed) for seed in bad), *hits]


@pytest.mark.parametrize(
    ("good", "bad", "number", "picked"),
    [
        ([5, 3, 9], [8, 2, 1], 4, [3, 5, 1, 2]),
        ([5, 3, 9], [8, 2, 1], 3, [3, 5, 1]),
        ([5, 3, 9], [8, 2, 1], 1, [3]),
        ([5, 3, 9], [8], 4, [3, 5, 9, 8]),
        ([], [8, 2, 1], 2, [1, 2]),
        ([5], [], 4, [5]),
        ([5, 3], [1], 0, []),
    ],
)
def test_the_first_of_each_outcome(
    good: list[int], bad: list[int], number: int, picked: list[int]
) -> None:
    assert [result.seed for result in pick_for_video(results(good, bad), number)] == picked


def test_names_say_seed_and_outcome() -> None:
    names = [video_name(result) for result in results([12], [7])]
    assert names == ["seed_000007_never_grasped.mp4", "seed_000012_success.mp4"]


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("obs", ["baseline", "current", "current_pred"])
def test_without_a_corruption_the_observed_target_is_the_true_one(
    env_config: EnvConfig, obs: str, relative: bool
) -> None:
    config = replace(env_config, spec=replace(env_config.spec, obs=obs, relative=relative))
    with config.make() as env:
        env.reset(seed=3)
        world = world_of(env)
        truth = world.target_track()[: config.spec.frames]
    observed = config.spec.target_positions(world.vector)
    assert observed.shape == (config.spec.frames, 3)
    np.testing.assert_allclose(observed, truth, atol=1e-6)  # float32


def test_dots_are_where_the_points_are_and_points_out_of_view_do_no_harm() -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    points = np.array([[10.0, 30.0], [np.nan, np.nan], [1e9, 0.0], [50.0, 5.0]])
    drawn = _dots(image, points, 2)
    assert tuple(drawn[30, 10]) == tuple(drawn[5, 50]) == CYAN
    assert not drawn[35:, 40:].any()
    assert not image.any()


@pytest.mark.gl
@pytest.mark.long
def test_a_video_is_the_replayed_episode(env_config: EnvConfig, tmp_path: Path) -> None:
    recording = Recording()
    with env_config.make() as env:
        env.reset(seed=0)
        for _ in range(4):
            recording.vectors.append(world_of(env).vector)
            recording.actions.append(np.zeros(7, np.float32))
            env.step(recording.actions[-1])
    path = tmp_path / "video.mp4"
    write_video(path, env_config, MISS, recording)
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 3 + 25  # steps 0, 2 and the last, which stays for a second
    assert frames[0].shape == (360, 4 * 480, 3)
    cyan = (np.abs(frames[0].astype(int) - CYAN) < 60).all(-1)  # after compression
    views = [cyan[:, 480 * i : 480 * (i + 1)].sum() for i in range(4)]
    assert views[3] > views[2] > 0  # the enlarged mouth shows larger dots
    with pytest.raises(RuntimeError, match="seed 0 ends otherwise than recorded"):
        write_video(tmp_path / "no.mp4", env_config, replace(MISS, is_success=True), recording)
    assert not (tmp_path / "no.mp4").exists()
