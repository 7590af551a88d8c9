"""A second task, made by following ``docs/add-an-environment.md``, goes through every command."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.commands import dataset, replay, rollout
from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.face_scene import FaceScene
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.policy import registry as policies
from robo_manip_baselines.rollout.results import read_results
from robo_manip_baselines.runs.errors import RequestError

from .conftest import install

ROOT = Path(__file__).resolve().parents[2]
TASKS = Path(__file__).parent
PAGE = ROOT / "docs" / "add-an-environment.md"
EPISODES = 6

POLICY = """
from robo_manip_baselines.policy.registry import POLICIES

ENTRY = POLICIES["Mlp"]
"""


def test_the_page_holds_the_files_of_the_task() -> None:
    blocks = re.findall(r"^\*\*`([^`]+)`\*\*\n\n```\w+\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
    files = [*sorted((TASKS / "chin_touch").glob("*.py")), TASKS / "pyproject.toml"]
    assert dict(blocks) == {str(f.relative_to(TASKS)): f.read_text() for f in files}


def test_the_page_names_methods_that_exist() -> None:
    table = PAGE.read_text().partition("| method | purpose |")[2].partition("\n\n")[0]
    names = re.findall(r"^\| `(\w+)\(", table, re.M)
    assert len(names) >= 8
    in_section: set[str] = set()
    for base, following in ((FaceEnv, "# -- Gymnasium --"), (FaceScene, "# -- start --")):
        source = inspect.getsource(base).partition("# -- task --")[2]
        in_section |= set(re.findall(r"def (\w+)\(", source.partition(following)[0]))
    assert in_section - {"predicted_target"} == set(names) - {"start_attributes"}


@pytest.fixture(scope="module")
def demonstrations(chin_touch: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Demonstrations of the expert, from two worker processes."""
    out = tmp_path_factory.mktemp("runs") / "demonstrations"
    options = f"{chin_touch} --scripted --cameras none --num_episodes {EPISODES} --preview 0"
    rollout.main([*options.split(), "--workers", "2", "--out", str(out)])
    return out


@pytest.mark.long
def test_the_expert_succeeds(demonstrations: Path) -> None:
    summary = json.loads((demonstrations / "summary.json").read_text())
    assert summary["episodes"] == EPISODES
    assert summary["successes"] >= EPISODES - 1
    assert summary["strict_successes"] >= EPISODES // 2


@pytest.mark.long
def test_its_episodes_are_whole_and_replay(
    demonstrations: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert dataset.main(["verify", str(demonstrations)]) == 0
    assert dataset.main(["info", str(demonstrations)]) == 0
    assert "robo_manip_baselines/ChinTouchEnv-v0" in capsys.readouterr().out
    path = list_episodes(demonstrations)[0]
    assert replay.main([str(path)]) == 0
    with EpisodeReader(path) as episode:
        chin, mouth = episode.array("chin_position"), episode.array("mouth_position")
        clock = episode.array("time")
    assert (np.linalg.norm(chin - mouth, axis=-1) > 0.03).all()
    assert (np.linalg.norm(chin - mouth, axis=-1) < 0.09).all()
    # The truth 5 frames (1/6 s) ahead is the truth then, between two control steps.
    later = np.stack([np.interp(clock + 5 / 30, clock, axis) for axis in chin[:, 0].T], -1)
    inside = clock + 5 / 30 < clock[-1]
    np.testing.assert_allclose(chin[inside, 5], later[inside], atol=3e-3)


@pytest.mark.long
def test_a_policy_is_trained_and_evaluated(
    demonstrations: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = pytest.importorskip("robo_manip_baselines.commands.train")
    run, out = tmp_path / "run", tmp_path / "results"
    options = "Mlp --env ChinTouchEnv --obs current --steps 20 --device cpu"
    options += " --logger none"
    assert train.main([*options.split(), f"--dataset={demonstrations}", f"--out={run}"]) == 0
    options = "ChinTouchEnv --policy Mlp --num_episodes 2 --num_envs 2 --workers 1"
    rollout.main([*options.split(), f"--checkpoint={run}", f"--out={out}"])
    table = capsys.readouterr().out
    assert "chin distance" in table
    assert "success in" not in table  # the task has no time limit for success
    results = read_results(out)
    assert [result.seed for result in results] == [1000, 1001]
    for result in results:
        assert (result.env, result.condition) == ("ChinTouchEnv", "current")
        assert result.observation is not None
        assert result.observation["obs"] == "current"
        assert set(result.columns) == {"chin_distance", "face_force"}
        assert result.is_success or result.failure in task_entry("ChinTouchEnv").failures


def test_its_target_is_observed_and_has_no_forecast(chin_touch: str) -> None:
    with closing(make_env(chin_touch, obs="current", cameras=())) as env:
        observation, _ = env.reset(seed=2)
        chin = world_of(env).landmark_track(199)[0]
        np.testing.assert_allclose(observation["chin"][:3], chin, atol=1e-6)  # float32
    with pytest.raises(RequestError, match=r"error model: predictors forecast the mouth, not"):
        make_env(chin_touch, obs="current_pred", cameras=(), corruption={"error": "model"})
    with pytest.raises(RequestError, match=r"prediction kalman: predictors forecast the mouth"):
        make_env(chin_touch, obs="current_pred", cameras=(), corruption={"prediction": "kalman"})
    with pytest.raises(RequestError, match="object_pose: ChinTouchEnv has no objects"):
        make_env(chin_touch, object_pose=True, cameras=())


@pytest.mark.long
def test_the_contract_holds_for_it(site: Path) -> None:
    contract = "tests/envs/test_env_contract.py"
    only = ("-k", "ChinTouchEnv")
    done = run_python(site, "-m", "pytest", "-q", "-p", "no:cacheprovider", *only, contract)
    assert done.returncode == 0, done.stdout
    assert "passed" in done.stdout


def test_another_package_registers_a_task_and_a_policy(site: Path, tmp_path: Path) -> None:
    (tmp_path / "my_policy.py").write_text(POLICY)
    group = "[robo_manip_baselines.policies]\nMyPolicy = my_policy:ENTRY\n"
    install(tmp_path, "my_policy", group)
    program = (
        "import gymnasium, robo_manip_baselines;"
        "print(gymnasium.spec('robo_manip_baselines/ChinTouchEnv-v0').max_episode_steps);"
        "from robo_manip_baselines.policy.registry import policy_entry;"
        "print(policy_entry('MyPolicy').model)"
    )
    done = run_python(site, "-c", program, more=tmp_path)
    assert done.stdout.startswith("400\n"), done.stderr
    if "entry_points" not in inspect.getsource(policies):
        pytest.skip("policy.registry does not look up entry points yet")
    assert done.stdout == "400\nrobo_manip_baselines.policy.mlp.model:MlpModel\n", done.stderr


def run_python(
    site: Path, *args: str, more: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run Python where the package of the page is installed."""
    path = [site, TASKS, ROOT, *([more] if more else [])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    command = [sys.executable, *args]
    return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
