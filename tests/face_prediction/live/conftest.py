"""A face, and a short drawn video."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

SIZE = (320, 240)


@pytest.fixture
def landmarks(make_track) -> np.ndarray:
    return make_track(np.array([[0.0, 0.0, -0.5]]), image_size=SIZE).landmarks[0]


@pytest.fixture
def clip(tmp_path: Path, write_video) -> Path:
    images = [np.full((SIZE[1], SIZE[0], 3), 40 + 5 * i, dtype=np.uint8) for i in range(20)]
    return write_video(tmp_path / "clip.mp4", images)
