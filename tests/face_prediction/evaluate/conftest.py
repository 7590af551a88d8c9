"""Drawn faces as a dataset, and toy networks that forecast them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import face_prediction.commands.evaluate as command
from face_prediction.commands.cli import main
from face_prediction.commands.evaluate import EvaluateOptions, run_evaluate
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import DatasetSplit
from face_prediction.evaluation.predictors import FittedPredictor
from face_prediction.forecast.interface import mouth_centre
from face_prediction.prediction.interface import Forecast, ImageNeeds
from face_prediction.tracking.detector import FaceDetection
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import FaceTrack, save_track
from robo_manip_baselines.runs.files import file_digest

SIZE = (320, 240)
TABLE = """clip,subject,ship,licence,source,what
one.mp4,ann,yes,MIT,here,talk
two.mp4,bob,yes,MIT,here,talk
three.mp4,cat,yes,MIT,here,talk
nod_a.mp4,dan,yes,MIT,here,"talk,nod"
nod_b.mp4,eve,yes,MIT,here,"talk,nod"
"""
CLIPS = ("one", "two", "three", "nod_a", "nod_b")


def draw(track: FaceTrack) -> list[np.ndarray]:
    """A red dot at the mouth of every frame, on a grey pattern that does not move."""
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(60, 120, (12, 16, 3), dtype=np.uint8), SIZE)
    images = []
    for u, v in track.landmarks[:, list(LIPS), :2].mean(axis=1) * SIZE:
        image = np.asarray(ground).copy()
        cv2.circle(image, (round(u * 16), round(v * 16)), 4 * 16, (255, 20, 20), -1, shift=4)
        images.append(image)
    return images


@pytest.fixture(scope="session")
def dataset(make_track, write_video, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("faces")
    (root / "videos").mkdir()
    (root / "clips.csv").write_text(TABLE)
    for number, name in enumerate(CLIPS):
        rng = np.random.default_rng(number)
        frames = 33
        mouth = np.tile([0.0, 0.0, -0.5], (frames, 1))
        step = rng.normal(0, 6e-4, (frames, 2))
        mouth[:, :2] = np.cumsum(0.002 * np.cos(np.arange(frames) / 4 + number)[:, None] + step, 0)
        track = make_track(mouth, image_size=SIZE, name=f"{name}.mp4")
        video = write_video(root / "videos" / f"{name}.mp4", draw(track))
        source = {"name": video.name, "sha256": file_digest(video)}
        save_track(root / "tracks" / f"{name}.npz", replace(track, source=source))
    words = ["build-dataset", root / "tracks", "--videos", root / "videos"]
    words += ["--attribution", root / "clips.csv", "--out", root / "dataset", "--no_progress"]
    words += ["--history", 8, "--future", 5, "--stride", 4, "--crop_size", 64, "--folds", 2]
    assert main([*map(str, words)]) == 0
    return root / "dataset"


def red_dots(images: np.ndarray) -> np.ndarray:
    """Position (..., 2) of the dot in images (..., S, S, 3)."""
    red = np.clip(images[..., 0].astype(float) - images[..., 1] - 60, 0, None)
    grid = (np.arange(red.shape[-1]) + 0.5) / red.shape[-1]
    total = red.sum(axis=(-1, -2))
    return np.stack([red.sum(-2) @ grid, red.sum(-1) @ grid], axis=-1) / total[..., None]


@dataclass
class Toy:
    """A network that puts the mouth where the last image has it, or where it last was."""

    name: str
    test_fold: int
    train_subjects: tuple[str, ...]
    size: int = 64
    reads: bool = True
    preset: str = "cpu"
    memory: int | None = 1

    @property
    def needs(self) -> ImageNeeds:
        return ImageNeeds(2, self.size)

    def predict(self, landmarks, images, horizon: int) -> Forecast:
        last = landmarks[:, -1:]
        shift = red_dots(images[:, -1:]) - mouth_centre(last) if self.reads else np.zeros((1, 2))
        ahead = (last + np.reshape(shift, (-1, 1, 1, 2))).repeat(horizon, axis=1)
        if self.name == "blind":
            ahead = np.full_like(ahead, np.nan)
        scale = np.full((len(last), horizon, 2), 0.05, dtype=np.float32)
        copies = images[:, -1:].repeat(horizon, axis=1)
        freedom = np.full((horizon, 2), 4.0)
        if self.name == "careless":
            return Forecast(ahead.astype(np.float32))
        return Forecast(ahead.astype(np.float32), copies, scale, freedom)


class DotDetector:
    """All landmarks at the red dot."""

    def __enter__(self) -> DotDetector:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        face = np.zeros((468, 3))
        face[:, :2] = red_dots(image)
        return [FaceDetection(face, np.eye(4))]


@pytest.fixture
def toys(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Toy]:
    """Folder names of checkpoints, and what is loaded from them."""
    with FaceDataset(dataset) as opened:
        people = [
            tuple(sorted({c.subject for c in opened.manifest.clips if c.fold != fold}))
            for fold in range(2)
        ]
    found = {}
    for fold in range(2):
        found[f"reader_{fold}"] = Toy("reader", fold, people[fold])
        found[f"idler_{fold}"] = Toy("idler", fold, people[fold], size=32, reads=False)
        found[f"blind_{fold}"] = Toy("blind", fold, people[fold])
        found[f"careless_{fold}"] = Toy("careless", fold, people[fold], reads=False)

    def load(folder: Path, dataset_sha256: str, split: DatasetSplit) -> FittedPredictor:
        assert dataset_sha256 == file_digest(dataset / "dataset.json")
        toy = found[folder.name]
        record = {"name": toy.name, "preset": toy.preset, "test_fold": toy.test_fold}
        return FittedPredictor(
            toy, frozenset(toy.train_subjects), folder, {"folder": folder.name, **record}
        )

    monkeypatch.setattr(command, "load_network", load)
    monkeypatch.setattr(command, "open_detector", lambda model: DotDetector())
    return found


def run(dataset: Path, out: Path, *checkpoints: str, **options) -> dict:
    words = {"baselines": ("line",), "resamples": 20, "progress": False, "figures": False}
    folders = tuple(map(Path, checkpoints))
    given = EvaluateOptions(dataset, folders, out=out, **{**words, **options})
    assert run_evaluate(given) == 0
    return json.loads((out / "results.json").read_text())


def rows_of(record: dict, kind: str = "natural") -> dict[str, dict]:
    return {row["name"]: row for row in record["kinds"][kind]["rows"]}
