"""Recorded episodes to play back, and sessions without a command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.rollout.demonstrate import Collection, Demonstration, collect
from robo_manip_baselines.teleop.session import TeleopSession

KWARGS: dict[str, Any] = {"cameras": [], "image_size": [480, 640], "face_motion": "episode"}


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], Path]:
    """Folder of a task's scripted episodes, seeds from 0 on, recorded when first asked for."""
    folders: dict[str, Path] = {}

    def record(env: str = "FeedingEnv", count: int = 1) -> Path:
        if env not in folders:
            folders[env] = tmp_path_factory.mktemp("recorded") / env
        expert = next(iter(task_entry(env).experts))
        collect(Collection(env, folders[env], expert, range(count), KWARGS))
        return folders[env]

    return record


class Store:
    """Keeps episodes in memory."""

    def __init__(self) -> None:
        self.episodes: list[Demonstration] = []

    def save(self, episode: Demonstration) -> str:
        self.episodes.append(episode)
        return "saved"

    def poll(self) -> str:
        return ""


@pytest.fixture(scope="module")
def feeding_env() -> Iterator[gymnasium.Env[Any, Any]]:
    """FeedingEnv without images."""
    with closing(make_env("FeedingEnv", cameras=())) as env:
        yield env


MakeSession = Callable[..., tuple[TeleopSession, Store]]


@pytest.fixture(scope="session")
def make_session() -> MakeSession:
    """Return what makes a session with all arms of an environment, and its store."""

    def make(
        env: gymnasium.Env[Any, Any], device: Any, seeds: Sequence[int] = (0,), **changes: Any
    ) -> tuple[TeleopSession, Store]:
        store = Store()
        given: dict[str, Any] = {
            "env_kwargs": KWARGS,
            "operator": "somebody",
            "device_name": "script",
            "step_limit": 600,
            "codec": "jpeg",
            "quality": 90,
            "steered": world_of(env).observation_spec.arm_names,
            **changes,
        }
        return TeleopSession(env, device, store, seeds, **given), store

    return make
