"""``render_mode="human"`` opens MuJoCo's viewer; here a stand-in for it, without a display."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import pytest

from robo_manip_baselines.envs.mujoco.tasks import face_env, face_scene
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.errors import RequestError


class FakeViewer:
    """Records the times at which it was synchronised."""

    def __init__(self, data: mujoco.MjData) -> None:
        self.data, self.times, self.is_closed = data, [], False

    def sync(self) -> None:
        assert not self.is_closed
        self.times.append(round(self.data.time, 6))

    def close(self) -> None:
        self.is_closed = True

    def is_running(self) -> bool:
        return not self.is_closed


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[FakeViewer]:
    """Viewers that were opened."""
    viewers: list[FakeViewer] = []

    def launch_passive(model: mujoco.MjModel, data: mujoco.MjData, **_: Any) -> FakeViewer:
        assert isinstance(model, mujoco.MjModel)
        viewers.append(FakeViewer(data))
        return viewers[-1]

    fake = SimpleNamespace(launch_passive=launch_passive)
    monkeypatch.setattr(mujoco, "viewer", fake, raising=False)
    monkeypatch.setattr(face_env, "viewer_problem", lambda: None)
    return viewers


def test_one_viewer_shows_every_step_until_it_is_closed(opened: list[FakeViewer]) -> None:
    env = make_env("FeedingEnv", cameras=(), render_mode="human")
    assert opened == []  # no window before the first episode
    env.reset(seed=0)
    (viewer,) = opened
    assert viewer.data is world_of(env).data
    for _ in range(3):
        env.step(env.action_space.sample())
    assert env.render() is None
    assert sorted(set(viewer.times)) == pytest.approx([0.0, 0.02, 0.04, 0.06])
    env.reset(seed=1)
    assert viewer.times[-1] == 0.0
    assert len(opened) == 1
    env.close()
    assert viewer.is_closed


def test_steps_are_shown_no_faster_than_in_life(
    opened: list[FakeViewer], monkeypatch: pytest.MonkeyPatch
) -> None:
    now, slept = [50.0], []

    def sleep(seconds: float) -> None:
        slept.append(round(seconds, 6))
        now[0] += seconds

    monkeypatch.setattr(face_env, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    env = make_env("FeedingEnv", cameras=(), render_mode="human")
    env.reset(seed=0)
    for taken in (0.005, 0.05, 0.015):  # of a step, the second one too long
        now[0] += taken
        env.step(env.action_space.sample())
    assert slept == [0.0, 0.015, 0.0, 0.005]
    opened[0].close()  # by the person
    env.step(env.action_space.sample())
    assert len(slept) == 4
    env.close()


def test_no_viewer_without_being_asked_for(opened: list[FakeViewer]) -> None:
    env = make_env("FeedingEnv", cameras=())
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert opened == []


@pytest.mark.parametrize(
    ("display", "problem"), [("", r"no display \(\$DISPLAY is not set\)"), (":9999", "no window")]
)
def test_without_a_display_one_line_says_so_before_anything_is_made(
    monkeypatch: pytest.MonkeyPatch, display: str, problem: str
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(face_scene, "build_cell", None)
    with pytest.raises(RequestError, match=f"^render mode 'human': {problem}.*rgb_array") as caught:
        make_env("FeedingEnv", cameras=(), render_mode="human")
    assert "\n" not in str(caught.value)


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(RequestError, match=r"unknown render mode 'humane' .*did you mean 'human'"):
        FeedingEnv(cameras=(), render_mode="humane")
