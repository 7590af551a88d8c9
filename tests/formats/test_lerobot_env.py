"""The environment plug-in for LeRobot, as far as it needs no LeRobot."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry, task_names

NAME = "lerobot_env_robo_manip_baselines"


@pytest.fixture(scope="module")
def view(load_script: Callable[[str], ModuleType]) -> Any:
    module = load_script(f"integrations/{NAME}/{NAME}/view.py")
    return module.LeRobotView


def test_lerobot_finds_the_distribution_by_its_name(repository: Path) -> None:
    folder = repository / "integrations" / NAME
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    # It imports the module of the distribution's own name.
    assert project["name"] == NAME
    assert (folder / NAME / "__init__.py").is_file()


def test_every_task_has_an_instruction_and_a_type(repository: Path) -> None:
    text = (repository / "integrations" / NAME / NAME / "__init__.py").read_text(encoding="utf-8")
    for name in task_names():
        assert task_entry(name).instruction.endswith(".")
        assert f'task: str | None = "{name}"' in text


@pytest.mark.gl
@pytest.mark.long
def test_an_episode_as_lerobot_runs_it(view: Any) -> None:
    options = {"obs": "current", "cameras": ("top", "angle"), "image_size": (48, 64)}
    env = view("FeedingEnv", max_episode_steps=3, render_mode="rgb_array", **options)
    same = make_env("FeedingEnv", **options).unwrapped
    assert env._max_episode_steps == 3
    assert env.task_description == task_entry("FeedingEnv").instruction
    assert view("FeedingEnv", cameras=()).observation_space.keys() == {"agent_pos"}
    observation, info = env.reset(seed=5, options={"lerobot_new_rollout": True})
    expected, _ = same.reset(seed=5)
    action = env.action_space.sample()
    for step in range(3):
        assert observation in env.observation_space
        np.testing.assert_array_equal(observation["agent_pos"], same.vector)
        for camera in ("top", "angle"):
            image = observation["pixels"][camera]
            np.testing.assert_array_equal(image, expected[f"images/{camera}"])
        assert info == {"is_success": False, "is_success_strict": False}
        observation, _, terminated, truncated, info = env.step(action)
        expected, *_ = same.step(action)
        assert not terminated
        assert truncated == (step == 2)
    assert env.render().shape == (48, 64, 3)
    env.close()
    same.close()


@pytest.mark.gl
@pytest.mark.long
def test_a_vector_environment_reports_success(view: Any) -> None:
    def make() -> gymnasium.Env[Any, Any]:
        return view("FeedingEnv", max_episode_steps=2, cameras=())

    same_step = gymnasium.vector.AutoresetMode.SAME_STEP
    envs = gymnasium.vector.SyncVectorEnv([make, make], autoreset_mode=same_step)
    _, info = envs.reset(seed=[0, 1])
    assert info["is_success"].tolist() == [False, False]
    assert envs.call("_max_episode_steps") == (2, 2)
    assert set(envs.call("task_description")) == {task_entry("FeedingEnv").instruction}
    for _ in range(2):
        _, _, _, truncated, info = envs.step(envs.action_space.sample())
    assert truncated.all()
    assert info["final_info"]["is_success"].tolist() == [False, False]
    envs.close()
