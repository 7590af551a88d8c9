"""Recorded episodes to play back, and sessions without a command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.rollout.demonstrate import Collection, Demonstration, collect
from robo_manip_baselines.teleop import keyboard
from robo_manip_baselines.teleop.device import ArmPose, Mode, SessionView
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


@pytest.fixture
def view() -> SessionView:
    """State in the middle of an episode with two arms, the right one active."""
    pose = ArmPose(np.array([0.2, 0.5, 0.3]), np.array([0.0, 0.0, 0.0, 1.0]), 1.0)
    nothing: Any = None
    return SessionView(
        mode=Mode.RECORDING,
        seed=3,
        step=50,
        step_limit=600,
        saved=1,
        wanted=5,
        steered=("left", "right"),
        active_arm="right",
        arms={"left": pose, "right": pose},
        is_success=False,
        has_policy=False,
        is_policy_acting=False,
        rate=49.96,
        missed=2,
        message="<recording>",
        world=nothing,
    )


class FakeViewer:
    """Window of MuJoCo that somebody else draws; keys are pressed by their codes."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, press: Any) -> None:
        self.model, self.data, self.press = model, data, press
        self.cam = mujoco.MjvCamera()
        self.texts: list[Any] = []
        self.heights: list[float] = []
        self.is_closed = False

    def lock(self) -> nullcontext[None]:
        return nullcontext()

    def set_texts(self, texts: list[Any]) -> None:
        self.texts = texts

    def sync(self) -> None:
        assert not self.is_closed
        self.heights.append(float(self.data.site("right/gripper").xpos[2]))

    def is_running(self) -> bool:
        return not self.is_closed

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[FakeViewer]:
    """Windows that were opened."""
    opened: list[FakeViewer] = []

    def launch_passive(
        model: mujoco.MjModel, data: mujoco.MjData, *, key_callback: Any, **_: Any
    ) -> FakeViewer:
        opened.append(FakeViewer(model, data, key_callback))
        return opened[-1]

    fake = SimpleNamespace(launch_passive=launch_passive)
    monkeypatch.setattr(mujoco, "viewer", fake, raising=False)
    monkeypatch.setattr(keyboard, "viewer_problem", lambda: None)
    return opened
