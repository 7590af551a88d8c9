"""Folders of small made-up episodes."""

from __future__ import annotations

from pathlib import Path

import pytest

from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images

LENGTHS = (6, 9, 4, 7, 5, 8)


@pytest.fixture(scope="session")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes, 39 frames, each with images of two cameras."""
    folder = tmp_path_factory.mktemp("episodes")
    for seed, steps in enumerate(LENGTHS):
        images = make_images(steps, cameras=("top", "angle"))
        path = episode_path(folder, seed, success=True)
        write_episode(path, make_arrays(steps, seed), images, make_attributes(seed))
    return folder
