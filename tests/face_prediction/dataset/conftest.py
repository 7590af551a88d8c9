"""Drawn videos and their tracks in a folder, and ``build-dataset`` run there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import FaceTrack, save_track
from robo_manip_baselines.runs.files import file_digest

SIZE = (320, 240)
TABLE = """clip,subject,ship,licence,source,what
one.mp4,ann,yes,MIT,here,"webcam,talk"
two.mp4,ann,yes,MIT,here,"webcam,talk"
three.mp4,bob,no,unknown,there,"talk,nod"
grid_a.mp4,cat,yes,CC BY 4.0,grid,talk
"""
SMALL = ("--history", "8", "--future", "2", "--stride", "4", "--crop_size", "64", "--folds", "3")


def draw(track: FaceTrack) -> list[np.ndarray]:
    """A red dot on grey at the mouth of every frame, and the frame's number as brightness."""
    images = []
    centres = track.landmarks[:, list(LIPS), :2].mean(axis=1) * SIZE
    for number, (u, v) in enumerate(centres):
        image = np.full((SIZE[1], SIZE[0], 3), 60 + 3 * number, dtype=np.uint8)
        cv2.circle(image, (round(u * 16), round(v * 16)), 4 * 16, (255, 20, 20), -1, shift=4)
        images.append(image)
    return images


@dataclass
class Folder:
    root: Path
    exit_code: Callable[[Sequence[str]], int]
    table: str = TABLE

    def run(self, *options: object, out: str = "dataset") -> int:
        words = ["build-dataset", self.root / "tracks", "--videos", self.root / "videos"]
        words += ["--attribution", self.root / "clips.csv", "--out", self.root / out]
        return self.exit_code([*map(str, words), "--no_progress", *SMALL, *map(str, options)])

    def clip(self, name: str, out: str = "dataset") -> Path:
        return self.root / out / "clips" / f"{name}.h5"


@pytest.fixture
def folder(tmp_path: Path, make_track, write_video, caplog, exit_code) -> Folder:
    caplog.set_level(logging.INFO)
    (tmp_path / "videos").mkdir()
    (tmp_path / "clips.csv").write_text(TABLE)
    for number, name in enumerate(("one", "two", "three", "grid_a")):
        frames = 20 + 4 * number
        mouth = np.tile([0.0, 0.0, -0.5], (frames, 1))
        mouth[:, 0] = 0.02 * np.sin(np.arange(frames) / 6 + number)
        mouth[:, 1] = 0.01 * np.cos(np.arange(frames) / 5)
        track = make_track(mouth, image_size=SIZE, name=f"{name}.mp4")
        video = write_video(tmp_path / "videos" / f"{name}.mp4", draw(track))
        source = {"name": video.name, "sha256": file_digest(video)}
        save_track(tmp_path / "tracks" / f"{name}.npz", replace(track, source=source))
    return Folder(tmp_path, exit_code)
