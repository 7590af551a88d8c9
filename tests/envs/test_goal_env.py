"""FeedingGoalEnv keeps gymnasium-robotics' and stable-baselines3's promises, and can be solved."""

from __future__ import annotations

import copy
import pickle
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import robo_manip_baselines  # noqa: F401  (registers the environments)
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import GRASP_OFFSET, servo
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE
from robo_manip_baselines.envs.mujoco.tasks.registry import task_names
from robo_manip_baselines.runs.errors import RequestError

gymnasium_robotics = pytest.importorskip(
    "gymnasium_robotics", reason="needs the extra 'rl' (gymnasium-robotics)"
)

ENV_ID = "robo_manip_baselines/FeedingGoalEnv-v0"

VARIANTS: dict[str, dict[str, Any]] = {
    "table, targets": {"start": "table", "action": "target"},
    "grasped, sparse": {"start": "grasped"},
    "grasped, dense": {"start": "grasped", "reward": "dense", "continuing": False},
}

# As for FeedingEnv: joint targets in radians are neither symmetric nor within [-1, 1].
ADVICE = "ignore:.*[Ww]e recommend .*a symmetric and normalized"


@pytest.fixture(params=sorted(VARIANTS))
def env(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    env = gymnasium.make(ENV_ID, **VARIANTS[request.param])
    yield env
    env.close()


@pytest.fixture
def grasped() -> Iterator[Any]:
    env = gymnasium.make(ENV_ID, start="grasped")
    yield env.unwrapped
    env.close()


def wander(env: gymnasium.Env[Any, Any], seed: int, steps: int = 30) -> list[tuple[Any, ...]]:
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    trace: list[tuple[Any, ...]] = [(observation, 0.0, False, False, info)]
    trace += [env.step(env.action_space.sample()) for _ in range(steps)]
    return trace


@pytest.mark.filterwarnings(ADVICE)
def test_gymnasiums_checks_have_nothing_to_say(env: gymnasium.Env[Any, Any]) -> None:
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.long
@pytest.mark.filterwarnings(ADVICE)
def test_stable_baselines3s_checks_have_nothing_to_say(env: gymnasium.Env[Any, Any]) -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="needs the extra 'rl' (stable-baselines3)"
    )
    checker.check_env(env.unwrapped, skip_render_check=True)


def test_it_is_a_goal_env_with_its_keys(env: gymnasium.Env[Any, Any]) -> None:
    assert isinstance(env.unwrapped, gymnasium_robotics.GoalEnv)
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    assert set(env.observation_space.spaces) == {"observation", "achieved_goal", "desired_goal"}
    world: Any = env.unwrapped
    assert len(world.observation_names) == len(set(world.observation_names))
    assert env.observation_space["observation"].shape == (len(world.observation_names),)


def test_reward_and_end_follow_from_the_goals_alone(env: gymnasium.Env[Any, Any]) -> None:
    """As `GoalEnv` demands, by its keywords and without info; one by one, and all at once."""
    world: Any = env.unwrapped
    trace = wander(world, seed=1)[1:]
    achieved = np.stack([step[0]["achieved_goal"] for step in trace])
    desired = np.stack([step[0]["desired_goal"] for step in trace])
    for column, method in enumerate(("reward", "terminated", "truncated"), start=1):
        compute = getattr(world, f"compute_{method}")
        given = [step[column] for step in trace]
        one_by_one = [
            compute(achieved_goal=a, desired_goal=d, info={})
            for a, d in zip(achieved, desired, strict=True)
        ]
        assert given == one_by_one
        together = compute(achieved_goal=achieved, desired_goal=desired, info=[{}] * len(trace))
        assert together.shape == (len(trace),)
        np.testing.assert_array_equal(together, given)


def test_same_seed_same_episode_in_copies_too(env: gymnasium.Env[Any, Any]) -> None:
    world: Any = env.unwrapped
    other = pickle.loads(pickle.dumps(world))
    first, second = wander(world, seed=5), wander(other, seed=5)
    branch = copy.deepcopy(world)
    action = env.action_space.sample()
    for one, two in ((first[-1], second[-1]), (world.step(action), branch.step(action))):
        for key in one[0]:
            np.testing.assert_array_equal(one[0][key], two[0][key])
        assert one[1:] == two[1:]
    third = wander(world, seed=6)
    assert any((first[-1][0][key] != third[-1][0][key]).any() for key in first[-1][0])


def test_observations_fit_share_no_memory_and_vary(env: gymnasium.Env[Any, Any]) -> None:
    observations = [step[0] for seed in range(3) for step in wander(env, seed)]
    for key in observations[0]:
        assert all(env.observation_space[key].contains(o[key]) for o in observations)
        assert not np.shares_memory(observations[0][key], observations[1][key])
        spread = np.ptp(np.stack([o[key] for o in observations]), axis=0)
        assert (spread > 0).all(), key


@pytest.mark.parametrize("out", [False, True])
def test_the_goal_is_a_box_around_the_mouth(grasped: Any, out: bool) -> None:
    mouth = np.array([0.01, 0.5, 0.35])
    for axis in np.eye(3):
        cube = mouth + axis * MOUTH_TOLERANCE * (1.01 if out else 0.99)
        assert grasped.compute_reward(cube, mouth, {}) == (-1.0 if out else 0.0)


def test_dense_rewards_are_distances_and_a_fall_truncates() -> None:
    env: Any = gymnasium.make(ENV_ID, reward="dense", continuing=False).unwrapped
    cube, mouth = np.array([[0.3, 0.5, 0.35], [0, 0.5, 0.35]]), np.array([0.0, 0.5, 0.35])
    np.testing.assert_allclose(env.compute_reward(cube, mouth, {}), [-0.3, 0.0])
    assert env.compute_terminated(cube, mouth, {}).tolist() == [False, True]
    fallen = np.array([[0.3, 0.5, -0.06], [0.3, 0.5, -0.04]])
    assert env.compute_truncated(fallen, mouth, {}).tolist() == [True, False]
    env.close()


def test_a_cube_off_the_table_ends_the_episode(grasped: Any) -> None:
    grasped.reset(seed=0)
    grasped.data.joint("cube").qpos[:3] = (0.0, 1.2, 0.0)  # beside the table, which ends at 0.9
    for _ in range(20):
        observation, _, terminated, truncated, _ = grasped.step(np.zeros(6, dtype=np.float32))
        if truncated:
            break
    assert observation["achieved_goal"][2] < -0.05
    assert (terminated, truncated) == (False, True)


def test_a_grasped_start_holds_the_cube_before_the_face(grasped: Any) -> None:
    places = []
    for seed in range(8):
        observation, info = grasped.reset(seed=seed)
        gripper = grasped.feeding.gripper_position
        held = observation["achieved_goal"] - gripper
        # Along the level fingers; it settles by less than a millimetre.
        assert np.linalg.norm(held) == pytest.approx(GRASP_OFFSET, abs=1e-3)
        assert abs(held[2]) < 1e-3
        assert not info["is_success"]
        for _ in range(15):
            observation, *_, info = grasped.step(np.zeros(6, dtype=np.float32))
        after = observation["achieved_goal"] - grasped.feeding.gripper_position
        np.testing.assert_allclose(after, held, atol=1e-3)
        assert info["face_force"] == 0.0
        places.append(gripper)
    assert (np.ptp(places, axis=0) > 0.03).all()  # drawn from 0.10, 0.16 and 0.16 m


def test_a_delta_moves_the_target_and_stops_at_the_limits(grasped: Any) -> None:
    grasped.reset(seed=0)
    before = grasped.step(np.zeros(6, dtype=np.float32))[0]["observation"]
    after = grasped.step(np.full(6, 2.0, dtype=np.float32))[0]["observation"]  # clipped to 1
    names = grasped.observation_names
    targets = [i for i, name in enumerate(names) if name.startswith("target_")]
    np.testing.assert_allclose(after[targets] - before[targets], 0.04, atol=1e-6)
    for _ in range(60):
        after = grasped.step(np.ones(6, dtype=np.float32))[0]["observation"]
    assert after[names.index("target_shoulder")] == pytest.approx(1.257, abs=1e-3)


def test_the_expert_reaches_the_goal() -> None:
    """The task is the same: what the servo of FeedingEnv commands brings the cube to the goal."""
    env: Any = gymnasium.make(ENV_ID, action="target", motion="sway").unwrapped
    env.reset(seed=3)
    expert = servo(env.feeding)
    expert.reset()
    rewards = [env.step(expert.act())[1] for _ in range(400)]
    assert rewards[:100] == [-1.0] * 100
    assert sum(reward == 0.0 for reward in rewards) > 50
    env.close()


def test_random_actions_explore(grasped: Any) -> None:
    """Noise moves the cube by more than the tolerance, and does not lose it."""
    for seed in range(3):
        cubes = np.stack([step[0]["achieved_goal"] for step in wander(grasped, seed, steps=100)])
        assert np.ptp(cubes, axis=0).max() > 0.06
        held = cubes[-1] - grasped.feeding.gripper_position
        assert np.linalg.norm(held) == pytest.approx(GRASP_OFFSET, abs=5e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reward": "shaped"}, "unknown reward 'shaped'; valid: dense, sparse"),
        ({"start": "held"}, "unknown start 'held'; valid: grasped, table"),
        ({"action": "torque"}, "unknown action 'torque'; valid: delta, target"),
        ({"tolerance": 0}, "tolerance 0: must be one positive number or three, in m"),
        ({"tolerance": (1, 2)}, "must be one positive number or three"),
        ({"obs": "current"}, "unknown argument 'obs'"),
        ({"motion": "dance"}, "unknown motion 'dance'"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message.replace("(", r"\(")):
        gymnasium.make(ENV_ID, **arguments)


def test_an_action_of_the_wrong_shape_or_not_finite_changes_nothing(grasped: Any) -> None:
    grasped.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of shape \(7,\): must be \(6,\)"):
        grasped.step(np.zeros(7))
    with pytest.raises(ValueError, match="nan in element 2, right/elbow"):
        grasped.step(np.array([0, 0, np.nan, 0, 0, 0]))
    assert np.isfinite(grasped.step(np.zeros(6))[0]["observation"]).all()


@pytest.mark.gl
def test_it_renders() -> None:
    env = gymnasium.make(ENV_ID, start="grasped", render_mode="rgb_array", render_size=(48, 64))
    env.reset(seed=0)
    image: Any = env.render()
    assert (image.shape, image.dtype) == ((48, 64, 3), np.uint8)
    assert image.std() > 10  # not blank
    env.close()


def test_commands_do_not_take_it() -> None:
    assert "FeedingGoalEnv" not in task_names()


def test_the_page_shows_the_example(repository: Path) -> None:
    page = (repository / "docs" / "reinforcement-learning.md").read_text(encoding="utf-8")
    script = (repository / "docs" / "train_sac_her.py").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(model = SAC.*?)```", page, re.DOTALL)
    assert textwrap.indent(shown, "    ") in script
    sentence = page.partition("Its options are ")[2].partition(".")[0]
    assert set(re.findall(r"`(--\w+)`", sentence)) == set(re.findall(r'"(--\w+)"', script))


def test_the_page_runs(repository: Path) -> None:
    page = (repository / "docs" / "reinforcement-learning.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(import gymnasium.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(shown, names)
    names["env"].close()
    for line in shown.splitlines():
        expression, sign, result = line.partition("  # ")
        assert not sign or eval(expression, names) == eval(result), line


@pytest.mark.slow
def test_the_example_trains(repository: Path, tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra 'rl' (stable-baselines3)")
    script = repository / "docs" / "train_sac_her.py"
    arguments = ["--steps", "900", "--episodes", "1", "--out", str(tmp_path / "policy")]
    done = subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "after training: " in done.stdout
    assert (tmp_path / "policy.zip").is_file()
