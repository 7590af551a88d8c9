"""Networks from their folders: one for each fold, and the same live as all at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from face_prediction.commands.live import load_forecaster
from face_prediction.dataset.histories import dataset_image
from face_prediction.dataset.manifest import ClipEntry, Manifest, write_manifest
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.evaluation.predictors import cross_fit
from face_prediction.live.streaming import StreamingPredictor
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
pytestmark = pytest.mark.long

SETTINGS = SequenceSettings(history=8, future=5, crop_size=64, margin=0.3)
SIZE = (320, 240)
FOLDS = {"ann": 0, "bob": 1, "cat": 2}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """The list of a dataset; nothing here reads its clips."""
    clips = tuple(
        ClipEntry(
            name, name, "natural", fold, True, "MIT", "here", "0", f"{name}.mp4", "0", 1, 1, {}
        )
        for name, fold in FOLDS.items()
    )
    folder = tmp_path / "data"
    folder.mkdir()
    write_manifest(folder, Manifest(SETTINGS, 3, 0, clips))
    return folder


@pytest.fixture
def trained(tmp_path: Path, dataset: Path) -> Callable[..., Path]:
    """A folder as ``train`` leaves it, of a tiny network with random weights."""
    from face_prediction.models.learned import CheckpointRecord, save_predictor_checkpoint
    from face_prediction.models.settings import make_predictor_model, settings_class

    def save(fold: int, model: str = "cross_attention", name: str = "", **changes: Any) -> Path:
        sizes = {"size": 32, "channels": (4, 8), "width": 16, "heads": 2, "feedforward": 16}
        settings = settings_class(model)().changed({**sizes, "layers": 1, "history": 8})
        torch.manual_seed(fold)
        record = CheckpointRecord(
            **{
                "model": model,
                "settings": settings.to_json(),
                "preset": "cpu",
                "training": {},
                "seed": 0,
                "dataset": SETTINGS.to_json(),
                "dataset_sha256": file_digest(dataset / "dataset.json"),
                "folds": {"train": [], "validation": [], "test": [fold]},
                "train_subjects": [name for name, own in FOLDS.items() if own != fold],
                "step": 1,
                "validation": {},
                "versions": {},
                **changes,
            }
        )
        folder = tmp_path / (name or f"{model}_{fold}")
        save_predictor_checkpoint(
            folder, record, make_predictor_model(model, settings).state_dict()
        )
        return folder

    return save


def test_each_fold_has_its_network(dataset: Path, trained) -> None:
    folders = [trained(2), trained(0)]
    with FaceDataset(dataset) as opened:
        fits = cross_fit(opened, folders, None)
    assert fits.name == "cross_attention"
    assert {fold: fitted.folder for fold, fitted in fits.by_fold.items()} == {
        2: folders[0], 0: folders[1],
    }  # fmt: skip
    assert fits.by_fold[0].subjects == {"bob", "cat"}
    assert fits.predictor_for(0, "ann") is fits.by_fold[0].predictor
    with pytest.raises(RequestError, match="subject 'bob' is of fold 1, and only the folds 0, 2"):
        fits.predictor_for(1, "bob")
    with pytest.raises(RequestError, match="trained on subject 'cat', who is in that fold"):
        fits.predictor_for(0, "cat")


def test_networks_that_do_not_belong_together_are_refused(dataset: Path, trained) -> None:
    first = trained(0)
    other = {
        "are both cross_attention for test fold 0": trained(0, name="again"),
        "is 'simple_fusion', .* is 'cross_attention'": trained(1, model="simple_fusion"),
        "give one checkpoint for each fold, or one": trained(1, dataset_sha256="f" * 64),
    }
    with FaceDataset(dataset) as opened:
        for message, folder in other.items():
            with pytest.raises(RequestError, match=message) as caught:
                cross_fit(opened, [first, folder], None)
            assert str(folder) in str(caught.value)
        with pytest.raises(RequestError, match="no such folder"):
            cross_fit(opened, [dataset / "nowhere"], None)


def test_live_says_what_the_network_says_of_the_whole_history(trained, make_track) -> None:
    from face_prediction.models.learned import LearnedPredictor

    folder = trained(0)
    name, forecaster, settings = load_forecaster(str(folder), None)
    assert (name, settings) == ("cross_attention", SETTINGS)
    stream = StreamingPredictor(forecaster, settings)
    path = np.array([0.0, 0.0, -0.5]) + 0.001 * np.arange(20)[:, None] * [1.0, -0.5, 0.0]
    landmarks = make_track(path, image_size=SIZE).landmarks
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, size=(20, SIZE[1], SIZE[0], 3), dtype=np.uint8)
    predictor = LearnedPredictor.load(folder)
    for now in range(20):
        forecast = stream.update(now / 30, landmarks[now], images[now])
        assert forecast is not None
        crop = forecast.crop
        rows = np.maximum(np.arange(now - 7, now + 1), 0)
        seen = crop.normalise(landmarks[rows], SIZE)[None, ..., :2].astype(np.float32)
        shown = np.stack([dataset_image(images[i], crop, SETTINGS, 32) for i in rows])[None]
        expected = predictor.predict(seen, shown, 5).landmarks[0]
        got = (forecast.landmarks * SIZE - [crop.left, crop.top]) / crop.side
        # one picture at a time and eight together add up in another order
        np.testing.assert_allclose(got, expected, atol=2e-6)


def test_a_network_without_landmarks_cannot_run_live(trained) -> None:
    with pytest.raises(RequestError, match="image_only: forecasts images and no landmarks"):
        load_forecaster(str(trained(0, model="image_only")), None)
