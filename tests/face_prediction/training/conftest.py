"""A small drawn dataset, and trainings of a tiny network on it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from face_prediction.commands.train import run_train
from face_prediction.dataset.clip_file import EncodedImages, write_clip
from face_prediction.dataset.manifest import (
    ClipEntry,
    Manifest,
    write_manifest,
)
from face_prediction.dataset.sequences import (
    SequenceSettings,
    clip_frames,
    find_sequences,
    sequence_statistics,
)
from face_prediction.tracking.geometry import LIPS
from face_prediction.training import trainer as trainer_module
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.windows import WindowBatch
from robo_manip_baselines.runs.images import encode_image

SEQUENCES = SequenceSettings(history=8, future=2, stride=4, crop_size=64)
PEOPLE = {"ann": 0, "bob": 0, "cat": 1, "dan": 2, "eve": 2}
SETTINGS = (
    "size=32",
    "channels=[8, 8]",
    "width=16",
    "heads=2",
    "layers=1",
    "feedforward=16",
    "dropout=0.1",
    "history=6",
    "horizon=2",
)


def face_pictures(landmarks: np.ndarray) -> list[np.ndarray]:
    """A red dot on grey at the mouth of landmarks (F, 468, 2 or 3) in crops."""
    pictures = []
    for u, v in landmarks[:, list(LIPS), :2].mean(axis=1):
        picture = np.full((64, 64, 3), 90, dtype=np.uint8)
        cv2.circle(picture, (round(u * 1024), round(v * 1024)), 64, (250, 30, 30), -1, shift=4)
        pictures.append(encode_image(picture, quality=95))
    return pictures


def make_dataset(folder: Path, make_track) -> Path:
    entries = []
    for number, (name, fold) in enumerate(PEOPLE.items()):
        mouth = np.tile([0.0, 0.0, -0.5], (18 + 4 * number, 1))
        mouth[:, 0] = 0.02 * np.sin(np.arange(len(mouth)) / 3 + number)
        frames = clip_frames(make_track(mouth), SEQUENCES)
        sequences = find_sequences(frames, SEQUENCES)
        encoded, index = [], np.zeros((len(sequences), SEQUENCES.length), dtype=np.int64)
        for row, (start, crop) in enumerate(zip(sequences.start, sequences.crops, strict=True)):
            shown = frames.landmarks[start : start + SEQUENCES.length]
            index[row] = len(encoded) + np.arange(SEQUENCES.length)
            encoded += face_pictures(crop.normalise(shown, frames.image_size))
        entry = ClipEntry(
            clip=name, subject=name, kind="natural", fold=fold, ship=True, licence="MIT",
            source="drawn", track_sha256="0", video="v.mp4", video_sha256="0",
            sequences=len(sequences), candidates=sequences.candidates, dropped={},
        )  # fmt: skip
        record = {"clip": name, "track_sha256": "0", "video_sha256": "0"}
        write_clip(
            folder / "clips" / f"{name}.h5",
            frames,
            sequences,
            EncodedImages(encoded, index),
            sequence_statistics(frames, sequences, SEQUENCES),
            {**record, "settings": SEQUENCES.to_json()},
        )
        entries.append(entry)
    write_manifest(folder, Manifest(SEQUENCES, folds=3, seed=0, clips=tuple(entries)))
    return folder


@pytest.fixture(scope="session")
def dataset(tmp_path_factory, make_track) -> Path:
    return make_dataset(tmp_path_factory.mktemp("faces"), make_track)


@pytest.fixture(scope="session")
def make_faces(make_track) -> Callable[[Path], Path]:
    """Writes the dataset to a folder."""
    return lambda folder: make_dataset(folder, make_track)


def twelve_steps(dataset: Path, out: Path) -> FaceTrainOptions:
    return FaceTrainOptions(
        model="cross_attention", dataset=dataset, out=out, settings=SETTINGS,
        steps=12, batch_size=3, validate_every=4, warmup_steps=2, ema_decay=0.5, augment=True,
        log_every=3, checkpoint_every=5, progress=False, device="cpu",
    )  # fmt: skip


@pytest.fixture
def options(dataset: Path, tmp_path: Path) -> FaceTrainOptions:
    return twelve_steps(dataset, tmp_path / "run")


@pytest.fixture(scope="session")
def whole(dataset: Path, tmp_path_factory) -> Path:
    """Run folder of the options, trained without interruption."""
    options = twelve_steps(dataset, tmp_path_factory.mktemp("runs") / "whole")
    assert run_train(options) == 0
    return options.folder


@pytest.fixture(scope="session")
def finished(dataset: Path, tmp_path_factory) -> FaceTrainOptions:
    """The options of a short run that is done; its folder is not to be changed."""
    options = FaceTrainOptions(
        model="cross_attention", dataset=dataset, out=tmp_path_factory.mktemp("runs") / "run",
        settings=SETTINGS, steps=1, batch_size=2, progress=False, device="cpu",
    )  # fmt: skip
    run_train(options)
    return options


@pytest.fixture
def trained(finished: FaceTrainOptions) -> Path:
    """The folder of a network; not to be changed."""
    return finished.folder


@pytest.fixture
def no_curves(monkeypatch) -> None:
    """Drawing takes longer than these trainings."""
    monkeypatch.setattr(trainer_module, "write_curves", lambda *arguments: None)


@pytest.fixture
def before_step(monkeypatch) -> Callable[[Callable[[int, WindowBatch], WindowBatch | None]], None]:
    """Sets a function that is given every step and its batch, and may raise or return another."""
    original = trainer_module.window_batches

    def install(function: Callable[[int, WindowBatch], WindowBatch | None]) -> None:
        def hooked(windows, settings, seed: int, start: int):
            batches = original(windows, settings, seed, start)
            with contextlib.closing(batches):
                for step, batch in enumerate(batches, start):
                    yield function(step, batch) or batch

        monkeypatch.setattr(trainer_module, "window_batches", hooked)

    return install
