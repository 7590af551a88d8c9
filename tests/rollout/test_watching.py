"""``--view``: episodes that are shown in MuJoCo's viewer give the same files as others."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import pytest

from robo_manip_baselines.commands.replay import ReplayOptions, replay_episodes
from robo_manip_baselines.commands.rollout import main
from robo_manip_baselines.data import episode_path
from robo_manip_baselines.envs.mujoco.tasks import face_env
from robo_manip_baselines.rollout.demonstrate import Collection, collect, deviation
from robo_manip_baselines.rollout.evaluation import EvaluationConfig, evaluate
from robo_manip_baselines.rollout.results import RESULTS
from robo_manip_baselines.runs.errors import RequestError

STEPS = 12


class FakeViewer:
    """Counts the states that it was shown."""

    def __init__(self) -> None:
        self.shown, self.is_open = 0, True

    def is_running(self) -> bool:
        return self.is_open

    def sync(self) -> None:
        self.shown += 1

    def close(self) -> None:
        self.is_open = False


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[FakeViewer]:
    """Viewers that were opened."""
    viewers: list[FakeViewer] = []

    def launch_passive(*_: Any, **__: Any) -> FakeViewer:
        viewers.append(FakeViewer())
        return viewers[-1]

    monkeypatch.setattr(
        mujoco, "viewer", SimpleNamespace(launch_passive=launch_passive), raising=False
    )
    monkeypatch.setattr(face_env, "viewer_problem", lambda: None)
    monkeypatch.setattr("robo_manip_baselines.envs.mujoco.cell.opengl.viewer_problem", lambda: None)
    return viewers


def collection(out: Path, **changes: Any) -> Collection:
    kwargs = {"cameras": [], "max_episode_steps": STEPS}
    plain = Collection("FeedingEnv", out, "reactive", range(2), kwargs)
    return replace(plain, **changes)


@pytest.mark.long
def test_a_recording_that_is_watched_is_the_same(tmp_path: Path, opened: list[FakeViewer]) -> None:
    collect(collection(tmp_path / "plain"))
    assert opened == []
    watched = collection(tmp_path / "watched", is_watched=True, workers=2)
    assert "is_watched" not in watched.to_json()
    collect(watched)
    assert sum(viewer.shown for viewer in opened) >= 2 * STEPS
    for seed in range(2):
        one, other = (episode_path(tmp_path / n, seed, False) for n in ("plain", "watched"))
        assert one.read_bytes() == other.read_bytes()
    found = deviation(one, is_watched=True)
    assert (found.qpos, found.qvel, found.steps) == (0.0, 0.0, STEPS)
    assert len(opened) == 2
    assert opened[1].shown > STEPS


@pytest.mark.long
def test_an_evaluation_that_is_watched_is_the_same(
    tmp_path: Path, opened: list[FakeViewer], make_checkpoint: Callable[..., Any]
) -> None:
    checkpoint = make_checkpoint(tmp_path / "checkpoint").folder
    lines = []
    for is_watched in (False, True):
        config = EvaluationConfig(
            checkpoint=checkpoint,
            seeds=range(1000, 1002),
            out=tmp_path / str(is_watched),
            workers=0,
            is_watched=is_watched,
        )
        assert "is_watched" not in config.to_json()
        evaluate(config)
        lines.append((tmp_path / str(is_watched) / RESULTS).read_text())
        assert len(opened) == is_watched
    assert lines[0] == lines[1]


def test_without_a_display_one_line_says_so_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    out = tmp_path / "out"
    with pytest.raises(RequestError, match=r"^--view: no display .*; leave it out, or write a vid"):
        main(["FeedingEnv", "--scripted", "--view", "--out", str(out)])
    assert not out.exists()
    with pytest.raises(RequestError, match=r"^--view: no display"):
        replay_episodes(ReplayOptions((tmp_path / "episode_000000.hdf5",), view=True))


@pytest.mark.slow
def test_a_window_on_a_virtual_display(tmp_path: Path) -> None:
    """MuJoCo's own viewer, under Xvfb."""
    if shutil.which("xvfb-run") is None:
        pytest.skip("no Xvfb: apt-get install xvfb")
    script = Path(__file__).parents[2] / "bin" / "Rollout.py"
    words = ["FeedingEnv", "--scripted", "--num_episodes", "1", "--cameras", "none", "--view"]
    command = [sys.executable, str(script), *words, "--preview", "0", "--out", str(tmp_path)]
    screen = ["xvfb-run", "--auto-servernum", "--server-args=-screen 0 800x600x24"]
    environment = {**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1"}
    done = subprocess.run(
        [*screen, *command], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "1/1" in done.stdout
