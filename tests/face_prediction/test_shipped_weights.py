"""The network in the package: loads, forecasts better than copying, and says whom it is from."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import face_prediction
from face_prediction.forecast import LandmarkSequences, fit_forecaster, mouth_centre
from face_prediction.models.learned import LearnedPredictor

FOLDER = Path(face_prediction.__file__).parent / "assets" / "residual"
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def shipped() -> LearnedPredictor:
    return LearnedPredictor.load(FOLDER)


def swaying_faces(count: int, frames: int) -> np.ndarray:
    """Heads (count, frames, 468, 2) that sway at 0.4 to 1 Hz, seen by a detector that jitters."""
    rng = np.random.default_rng(0)
    shape = rng.uniform(0.25, 0.75, (468, 2))
    time = np.arange(frames) / 30
    rate, phase = rng.uniform(0.4, 1.0, (2, count, 2)) * [[[1.0]], [[6.0]]]
    sway = 0.03 * np.sin(2 * np.pi * rate[:, None] * time[:, None] + phase[:, None])
    jitter = rng.normal(0, 2e-4, (count, frames, 468, 2))
    return (shape + sway[:, :, None] + jitter).astype(np.float32)


def test_it_is_small_and_of_the_cpu_preset(shipped: LearnedPredictor) -> None:
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) < 10_000_000
    assert (shipped.name, shipped.record.preset) == ("residual", "cpu")


def test_everybody_it_is_from_is_attributed(shipped: LearnedPredictor) -> None:
    with (FOLDER / "attribution.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["subject"] for row in rows} == set(shipped.record.train_subjects)
    assert all(row["licence"] and row["source"] for row in rows)


def test_it_forecasts_swaying_heads_better_than_copying(shipped: LearnedPredictor) -> None:
    faces = swaying_faces(6, 75)
    needs = shipped.needs
    blank = np.full((6, needs.frames, needs.size, needs.size, 3), 128, dtype=np.uint8)
    forecast = shipped.predict(faces[:, :70], blank, 5)
    truth = mouth_centre(faces[:, 70:])
    copy = fit_forecaster("persistence", LandmarkSequences(faces, tuple("abcdef")))
    still = mouth_centre(copy.predict(faces[:, :70], 5))
    ours = np.abs(mouth_centre(forecast.landmarks) - truth).mean(axis=(0, 2))
    theirs = np.abs(still - truth).mean(axis=(0, 2))
    assert np.all(ours < 0.5 * theirs)
    assert forecast.images is not None
    assert forecast.mouth_scale is not None
    # a promised scale is of the size of the errors that are made
    assert 0.2 < float(forecast.mouth_scale.mean() / ours.mean()) < 5.0
