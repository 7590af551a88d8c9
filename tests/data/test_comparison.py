"""A comparison finds what was changed, and nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.commands.dataset import comparison_text
from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.comparison import EpisodeComparison, compare_episodes
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images

SCRIPT = Path(__file__).parents[2] / "bin" / "Dataset.py"
STEPS = 12


def write(folder: Path, arrays: dict[str, np.ndarray], **changes: Any) -> Path:
    images = changes.pop("images", None)
    images = make_images(len(arrays["time"])) if images is None else images
    return write_episode(
        episode_path(folder, 0, True), arrays, images, make_attributes(0) | changes
    )


def compared(one: Path, other: Path) -> EpisodeComparison:
    with EpisodeReader(one) as a, EpisodeReader(other) as b:
        return compare_episodes(a, b)


@pytest.fixture
def original(tmp_path: Path) -> Path:
    return write(tmp_path / "a", make_arrays(STEPS))


def test_an_episode_is_the_same_as_itself(original: Path, tmp_path: Path) -> None:
    other = write(tmp_path / "b", make_arrays(STEPS))
    found = compared(original, other)
    assert found.is_same
    assert found.first_step is None
    assert comparison_text(found, ("a", "b")).startswith("the same: 12 steps")


def test_numbers_that_differ(original: Path, tmp_path: Path) -> None:
    arrays = make_arrays(STEPS)
    arrays["action"][5:, 2] += 0.3
    arrays["action"][7, 2] += 0.1
    arrays["mouth_position"][3, 1, 2] -= 0.5
    found = compared(original, write(tmp_path / "b", arrays))
    assert not found.is_same
    assert found.first_step == 3
    mouth, action = found.columns  # the earlier one first
    assert (mouth.field, mouth.column, mouth.unit) == ("mouth_position", "1 z", "m")
    assert (mouth.first_step, mouth.steps) == (3, 1)
    assert mouth.rms == pytest.approx(0.5 / np.sqrt(STEPS))
    with EpisodeReader(original) as episode:
        assert action.column == episode.attributes["action_names"][2]
    assert (action.first_step, action.steps) == (5, 7)
    assert action.largest == pytest.approx(0.4)
    assert action.rms == pytest.approx(np.sqrt((6 * 0.3**2 + 0.4**2) / STEPS))
    text = comparison_text(found, ("a", "b"))
    assert text.endswith("first difference at step 3")
    assert "mouth_position  1 z" in text


def test_attributes_that_differ(original: Path, tmp_path: Path) -> None:
    kwargs = make_attributes(0)["env_kwargs"] | {"obs": "current"}
    other = write(tmp_path / "b", make_arrays(STEPS), expert="other", env_kwargs=kwargs)
    found = compared(original, other)
    assert set(found.attributes) == {"expert", "env_kwargs.obs"}
    assert found.attributes["expert"][1] == "other"
    assert found.columns == ()
    assert "attribute expert: " in comparison_text(found, ("a", "b"))


def test_nan_is_the_same_as_nan(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / name, make_arrays(STEPS), completion_time=float("nan")) for name in "ab"
    ]
    assert compared(*paths).is_same


def test_episodes_of_two_lengths(original: Path, tmp_path: Path) -> None:
    shorter = {name: values[:-3] for name, values in make_arrays(STEPS).items()}
    found = compared(original, write(tmp_path / "b", shorter))
    assert found.lengths == (STEPS, STEPS - 3)
    assert not found.is_same
    assert found.columns == ()
    assert "steps: 12 and 9; the first 9 compared" in comparison_text(found, ("a", "b"))


def test_images_and_fields_that_one_lacks(original: Path, tmp_path: Path) -> None:
    images = make_images(STEPS)
    images["top"][4] = images["top"][9]
    del images["front_close"]
    arrays = make_arrays(STEPS, version=4)
    found = compared(original, write(tmp_path / "b", arrays, images=images))
    assert found.only_in["front_close"] == 0
    assert found.only_in["region_force"] == 1
    assert found.shapes["mouth_position"][1] == (STEPS, 25, 3)
    (image,) = found.images
    assert (image.camera, image.first_step, image.steps) == ("top", 4, 1)
    assert image.mean is not None
    assert image.mean > 0
    text = comparison_text(found, ("left.hdf5", "right.hdf5"))
    assert "front_close: only in left.hdf5" in text
    assert "images of top: 1 differ, first at step 4" in text


def test_long_lists_are_cut(original: Path, tmp_path: Path) -> None:
    arrays = make_arrays(STEPS)
    arrays["qpos"] = arrays["qpos"] + 1.0
    arrays["qpos"][:, 17] += 1.0
    found = compared(original, write(tmp_path / "b", arrays))
    assert len(found.columns) == arrays["qpos"].shape[1]
    lines = comparison_text(found, ("a", "b"), columns=3).splitlines()
    assert sum(line.startswith("qpos") for line in lines) == 4
    assert lines[1].split()[1] == "17"  # the largest difference
    assert "… 20 more" in lines[4]
    whole = comparison_text(found, ("a", "b"), columns=0)
    assert whole.count("qpos") == len(found.columns)


def test_the_command(original: Path, tmp_path: Path) -> None:
    arrays = make_arrays(STEPS)
    arrays["jaw_opening"] = arrays["jaw_opening"] + 0.01
    other = write(tmp_path / "b", arrays)
    for paths, code in (((original, original), 0), ((original, other), 1)):
        command = [sys.executable, str(SCRIPT), "compare", *map(str, paths)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr
    assert "jaw_opening" in done.stdout
    command = [sys.executable, str(SCRIPT), "compare", str(original), str(tmp_path / "no.hdf5")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
