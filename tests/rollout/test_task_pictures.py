"""``bin/Tasks.py``: every registered task is listed, and drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from robo_manip_baselines.commands import tasks
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry, task_names
from robo_manip_baselines.rollout import task_pictures
from robo_manip_baselines.rollout.task_pictures import VIEW, draw_task, tile_tasks
from robo_manip_baselines.runs.errors import RequestError


def test_lists_every_task_with_its_experts(capsys: pytest.CaptureFixture[str]) -> None:
    tasks.main([])
    shown = capsys.readouterr().out
    for name in task_names():
        _, found, section = shown.partition(f"{name}\n")
        assert found
        assert task_entry(name).success in section
        assert f"experts  {', '.join(task_entry(name).experts)}\n" in section
    assert "utensil  gripper, spoon\n" in shown


def test_tiles_are_two_in_a_row_and_the_last_row_is_filled_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def draw(name: str, seed: int) -> np.ndarray:
        return np.full((2, 3, 3), int(name) + seed, np.uint8)

    monkeypatch.setattr(task_pictures, "draw_task", draw)
    np.testing.assert_array_equal(
        tile_tasks(["1", "2", "3"], 10)[..., 0],
        [[11] * 3 + [12] * 3] * 2 + [[13] * 3 + [255] * 3] * 2,
    )
    assert tile_tasks(["1"], 0).shape == (2, 3, 3)


@pytest.mark.gl
@pytest.mark.long
def test_draws_the_expert_at_work_and_at_its_success() -> None:
    height, width = VIEW
    image = draw_task("FaceWipingEnv", seed=0)
    assert image.shape == (height, 2 * width, 3)
    for view in (image[:, :width], image[:, width:]):
        assert view.std() > 20.0  # something is to be seen
    assert not np.array_equal(image[:, :width], image[:, width:])


@pytest.mark.gl
def test_writes_a_png_and_replaces_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = np.full((4, 6, 3), (255, 0, 0), np.uint8)
    monkeypatch.setattr(task_pictures, "tile_tasks", lambda names, seed: drawn)
    path = tmp_path / "tasks.png"
    tasks.main(["--picture", str(path)])
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], drawn)
    with pytest.raises(RequestError, match="is there already"):
        tasks.main(["--picture", str(path)])
    with pytest.raises(RequestError, match=r"is no PNG; name an \.png file"):
        tasks.main(["--picture", str(tmp_path / "tasks.jpg")])
