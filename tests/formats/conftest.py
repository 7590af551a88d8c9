"""Small episodes to convert."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images

CAMERAS = ("front_close", "top")
LENGTHS = (12, 15, 11)


def write_folder(folder: Path, *, arms: int = 1, lengths: tuple[int, ...] = LENGTHS) -> Path:
    """Write episodes of these lengths, with the seeds 0, 1, ..., and a failure beside them."""
    for seed, steps in enumerate(lengths):
        arrays = make_arrays(steps, seed, arms=arms, version=4)
        arrays["is_success"] = np.arange(steps) >= steps - 3
        images = make_images(steps, cameras=CAMERAS)
        write_episode(
            episode_path(folder, seed, True), arrays, images, make_attributes(seed, arms=arms)
        )
    failure = make_attributes(9, arms=arms) | {"is_success": False, "completion_time": float("nan")}
    arrays = make_arrays(10, 9, arms=arms, version=4)
    write_episode(episode_path(folder, 9, False), arrays, make_images(10, cameras=CAMERAS), failure)
    return folder


@pytest.fixture(scope="session")
def one_arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three demonstrations of one arm, and a failure."""
    return write_folder(tmp_path_factory.mktemp("one_arm"))


@pytest.fixture(scope="session")
def two_arms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Likewise, of two arms."""
    return write_folder(tmp_path_factory.mktemp("two_arms"), arms=2)


def tree(folder: Path) -> dict[str, bytes]:
    """Return the content of every file of a folder by its relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(name="tree", scope="session")
def tree_fixture() -> object:
    """Return `tree`."""
    return tree
