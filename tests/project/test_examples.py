"""Every example runs, with small numbers, from a folder of its own."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.rollout.demonstrate import demonstrate

FOLDER = Path(__file__).parents[2] / "examples"


def run(path: Path, cwd: Path, *options: str, **numbers: object) -> str:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [str(FOLDER.parent), os.getenv("PYTHONPATH")])),
        **{name: str(value) for name, value in numbers.items()},
    }
    command = [sys.executable, *options, str(path)]
    done = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def cells(notebook: Path) -> list[str]:
    content = json.loads(notebook.read_text(encoding="utf-8"))
    assert content["nbformat"] == 4
    assert not any(cell.get("outputs") for cell in content["cells"])  # nothing of a run is kept
    return ["".join(c["source"]) for c in content["cells"] if c["cell_type"] == "code"]


def test_every_example_is_listed_and_tested(repository: Path, project_files: list[Path]) -> None:
    page = (repository / "docs" / "examples.md").read_text(encoding="utf-8")
    tests = Path(__file__).read_text(encoding="utf-8")
    found = [path for path in project_files if path.parts[0] == "examples"]
    assert len(found) == 4
    for path in found:
        assert f"`{path.as_posix()}`" in page
        assert f'"{path.name}"' in tests


def test_the_notebook_begins_with_the_installation() -> None:
    first, *others = cells(FOLDER / "notebook.ipynb")
    assert first.startswith("%pip install ")
    assert '--editable "..' in first
    assert (FOLDER / ".." / "constraints.txt").exists()
    assert not any(cell.startswith("%") for cell in others)


@pytest.mark.slow
def test_vector_environments(tmp_path: Path) -> None:
    path = FOLDER / "vector_environments.py"
    text = run(path, tmp_path, "-W", "error", NUM_ENVS=2, STEPS=10)
    assert "20 steps, 0 episodes ended" in text


@pytest.mark.slow
def test_own_policy(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="pip install torch")
    text = run(FOLDER / "own_policy.py", tmp_path, EPISODES=2, STEPS=20, TRIALS=1)
    assert "Gru, current" in text or "Gru, baseline" in text
    assert (tmp_path / "own_policy" / "run").is_dir()
    lines = (tmp_path / "own_policy" / "results" / "results.jsonl").read_text().splitlines()
    assert [json.loads(line)["policy"] for line in lines] == ["Gru"]
    # Once more: nothing is recorded, trained or evaluated twice.
    again = run(FOLDER / "own_policy.py", tmp_path, EPISODES=2, STEPS=20, TRIALS=1)
    assert again.splitlines()[0] == text.splitlines()[0]


@pytest.mark.slow
@pytest.mark.gl
def test_read_episodes(tmp_path: Path) -> None:
    kwargs = {"cameras": ("top",), "image_size": (24, 32), "max_episode_steps": 10}
    with closing(make_env("FeedingEnv", **kwargs)) as env:
        recorded = demonstrate(env, "reactive", 3, codec="jpeg", quality=90)
    write_episode(episode_path(tmp_path / "dataset/FeedingEnv", 3, True), *recorded)
    text = run(FOLDER / "read_episodes.py", tmp_path)
    code = (FOLDER / "read_episodes.py").read_text(encoding="utf-8")
    assert not re.search(r"^\s*(import|from) (robo_manip_baselines|cv2)", code, re.MULTILINE)
    assert "1 demonstrations" in text
    assert "episode_000003.hdf5: 0.20 s" in text
    assert (tmp_path / "top.jpg").read_bytes()[:2] == b"\xff\xd8"


@pytest.mark.slow
@pytest.mark.gl
def test_notebook(tmp_path: Path) -> None:
    """The code cells after the installation, one after another."""
    pytest.importorskip("torch", reason="pip install torch")
    script = tmp_path / "notebook.py"
    script.write_text("\n\n".join(cells(FOLDER / "notebook.ipynb")[1:]), encoding="utf-8")
    text = run(script, tmp_path)
    assert "reach" in text
    assert (tmp_path / "episode.mp4").stat().st_size > 10_000
    assert len((tmp_path / "notebook_results" / "results.jsonl").read_text().splitlines()) == 2
