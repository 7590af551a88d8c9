"""The scripted experts feed, hold on to the cube, and do the same every time."""

from __future__ import annotations

from collections.abc import Iterator

import mink
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import FeedingProgress, Phase
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env


@pytest.fixture(scope="module", params=["episode", "after_lift"])
def world(request: pytest.FixtureRequest) -> Iterator[FeedingEnv]:
    env = make_env("FeedingEnv", cameras=(), face_motion=request.param)
    assert isinstance(env.unwrapped, FeedingEnv)
    yield env.unwrapped
    env.close()


def cube_in_gripper(world: FeedingEnv) -> np.ndarray:
    """(3,) m: the cube's centre in the frame of the gripper."""
    gripper = mink.SO3(world.gripper_orientation)
    return gripper.inverse().apply(world.cube_position - world.gripper_position)


def feed(world: FeedingEnv, expert: str, seed: int) -> tuple[FeedingProgress, list[np.ndarray]]:
    """Play an episode; return how it went, and the cube in the gripper while only that held it."""
    actor = ENTRY.make_expert(expert, world)
    world.reset(seed=seed)
    actor.reset()
    carried, touched = [], False
    inside = world.model.geom_contype == MOUTH  # the inside of the mouth, pushing on the cube
    for _ in range(600):
        _, _, terminated, _, _ = world.step(actor.act())
        touched = touched or bool(inside[world.data.contact.geom].any())
        if world.progress.phase is Phase.CARRY and not touched:
            carried.append(cube_in_gripper(world))
        if terminated:
            break
    return world.progress, carried


@pytest.mark.parametrize("expert", sorted(ENTRY.experts))
def test_feeds_and_lets_go(world: FeedingEnv, expert: str) -> None:
    progress, carried = feed(world, expert, seed=0)
    assert progress.is_success
    assert progress.is_clear
    assert progress.completion_time is not None
    assert 0.0 < progress.completion_time <= 6.0  # the approach limit of Algorithm 1
    assert np.ptp(carried, axis=0).max() < 2e-3  # m; the cube stays where it was gripped


def test_the_face_waits_for_the_lift_or_does_not(world: FeedingEnv) -> None:
    actor = ENTRY.make_expert("reactive", world)
    world.reset(seed=1)
    actor.reset()
    start = world.mouth_track[0]
    while world.progress.lift_time is None:
        moved = np.linalg.norm(world.mouth_track[0] - start)
        if world.face_motion == "after_lift":
            assert moved == 0.0
        world.step(actor.act())
    lifted_at = world.step_count
    if world.face_motion == "episode":
        assert moved > 1e-3
    for _ in range(50):
        world.step(actor.act())
    since = world.step_count - (lifted_at if world.face_motion == "after_lift" else 0)
    displacement, _, _ = world.segment.at(since * 0.02)
    np.testing.assert_allclose(world.mouth_track[0], start + displacement, atol=1e-9)
    site = world.data.site("mouth").xpos
    # The site is where the last physics step found it.
    np.testing.assert_allclose(site, world.mouth_track[0], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("expert", ["reactive", "anticipatory"])  # test_servo.py has the other
def test_at_least_48_of_50_episodes_succeed(expert: str) -> None:
    env = make_env("FeedingEnv", cameras=())
    assert isinstance(env.unwrapped, FeedingEnv)
    outcomes = [feed(env.unwrapped, expert, seed) for seed in range(50)]
    env.close()
    failed = [seed for seed, (progress, _) in enumerate(outcomes) if not progress.is_success]
    assert len(failed) <= 2, failed
    slips = [np.ptp(carried, axis=0).max() for _, carried in outcomes]
    assert max(slips) < 2e-3  # m, from the lift to the lips
