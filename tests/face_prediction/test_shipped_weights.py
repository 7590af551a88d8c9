"""The weights in the package: load, forecast better than copying, and say whom they are from."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import face_prediction
from face_prediction.forecast import FORECASTERS, mouth_centre
from face_prediction.prediction.interface import StatefulPredictor

pytest.importorskip("torch", reason="PyTorch is not installed (extra face-prediction)")
from face_prediction.evaluation.predictors import UNFITTED
from face_prediction.models.loading import SHIPPED, load_baselines, load_predictor

FOLDER = Path(face_prediction.__file__).parent / "assets" / "residual"
pytestmark = pytest.mark.long


def swaying_faces(count: int, frames: int) -> np.ndarray:
    """Heads (count, frames, 468, 2) that sway at 0.4 to 1 Hz, seen by a detector that jitters."""
    rng = np.random.default_rng(0)
    shape = rng.uniform(0.25, 0.75, (468, 2))
    time = np.arange(frames) / 30
    rate, phase = rng.uniform(0.4, 1.0, (2, count, 2)) * [[[1.0]], [[6.0]]]
    sway = 0.03 * np.sin(2 * np.pi * rate[:, None] * time[:, None] + phase[:, None])
    jitter = rng.normal(0, 2e-4, (count, frames, 468, 2))
    return (shape + sway[:, :, None] + jitter).astype(np.float32)


def test_they_are_small() -> None:
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) < 2_000_000


def test_everybody_they_are_from_is_attributed() -> None:
    _, record = load_predictor(SHIPPED)
    with (FOLDER / "attribution.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["subject"] for row in rows} == set(record.train_subjects)
    assert all(row["licence"] and row["source"] for row in rows)


def test_baselines_are_beside_them() -> None:
    baselines, people = load_baselines(SHIPPED)
    assert {baseline.name for baseline in baselines} == set(FORECASTERS) - set(UNFITTED)
    assert people == set(load_predictor(SHIPPED)[1].train_subjects)


def test_they_forecast_swaying_heads_better_than_copying() -> None:
    faces = swaying_faces(6, 94)
    predictor, _ = load_predictor(SHIPPED)
    assert isinstance(predictor, StatefulPredictor)
    forecast = predictor.predict(faces[:, :70], None, 24)
    truth = mouth_centre(faces[:, 70:])
    still = np.abs(mouth_centre(faces[:, 69:70]) - truth).mean(axis=(0, 2))
    ours = np.abs(mouth_centre(forecast.landmarks) - truth).mean(axis=(0, 2))
    assert np.all(ours[:8] < 0.6 * still[:8])
    assert ours.mean() < still.mean()
    assert forecast.mouth_scale is not None
    # a promised scale is of the size of the errors that are made
    assert 0.2 < float(forecast.mouth_scale.mean() / ours.mean()) < 5.0
