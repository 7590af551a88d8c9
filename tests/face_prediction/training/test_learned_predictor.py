"""A trained network as a predictor, and checkpoints that are refused."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from face_prediction.commands.train import run_train
from face_prediction.models.interface import History
from face_prediction.models.learned import LearnedPredictor, read_tensors, write_tensors
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long


class TestLearnedPredictor:
    def inputs(self, rows: int = 5) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(0)
        images = rng.integers(0, 256, (rows, 6, 32, 32, 3), dtype=np.uint8)
        return rng.uniform(0, 1, (rows, 8, 468, 2)), images

    def test_what_it_says_of_itself(self, trained: Path) -> None:
        predictor = LearnedPredictor.load(trained)
        assert predictor.name == "cross_attention"
        assert predictor.memory == 6
        assert (predictor.needs.frames, predictor.needs.size) == (6, 32)
        assert predictor.record.train_subjects == ["dan", "eve"]

    def test_batches_and_horizons(self, trained: Path) -> None:
        landmarks, images = self.inputs()
        whole = LearnedPredictor.load(trained).predict(landmarks, images, 2)
        assert whole.landmarks.shape == (5, 2, 468, 2)
        assert whole.landmarks.dtype == np.float32
        assert whole.images is not None
        assert whole.images.shape == (5, 2, 32, 32, 3)
        assert whole.images.dtype == np.uint8
        assert whole.mouth_scale is None
        parts = LearnedPredictor.load(trained, batch_size=2).predict(landmarks, images, 2)
        np.testing.assert_allclose(parts.landmarks, whole.landmarks, atol=1e-6)
        assert np.abs(parts.images.astype(int) - whole.images).max() <= 1  # pyright: ignore
        one = LearnedPredictor.load(trained).predict(landmarks[:, 2:], images, 1)
        np.testing.assert_allclose(one.landmarks, whole.landmarks[:, :1], atol=1e-6)

    def test_pictures_come_out_as_they_went_in(self, trained: Path) -> None:
        """Colours and rows in their places: the network's output against the array's."""
        predictor = LearnedPredictor.load(trained)
        landmarks, images = self.inputs(1)
        got = predictor.predict(landmarks, images, 2).images
        with torch.no_grad():
            history = History(
                torch.tensor(landmarks[:, 2:], dtype=torch.float32), torch.tensor(images)
            )
            out = predictor.model(history).images.numpy()
        expected = out.transpose(0, 1, 3, 4, 2) * 255
        assert got is not None
        np.testing.assert_allclose(got, expected, atol=0.51)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda x, p: (x, p, 3), "horizon 3: cross_attention forecasts 1 to 2"),
            (lambda x, p: (x, p, 0), "horizon 0"),
            (lambda x, p: (x[:, :5], p, 1), "a history of 5 frames; cross_attention needs 6"),
            (lambda x, p: (x[..., :1], p, 1), "expected .histories, frames, 468, 2"),
            (lambda x, p: (x[0], p, 1), "landmarks of shape"),
            (lambda x, p: (x, None, 1), "images: none"),
            (lambda x, p: (x, p[:, 1:], 1), "needs uint8 of shape .5, 6, 32, 32, 3"),
            (lambda x, p: (x, p[:4], 1), "needs uint8 of shape"),
            (lambda x, p: (x, p / 255, 1), "float64"),
            (lambda x, p: (np.where(np.arange(468)[:, None] == 9, np.nan, x), p, 1), "NaN"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, trained: Path, change, words: str) -> None:
        with pytest.raises(RequestError, match=words):
            LearnedPredictor.load(trained).predict(*change(*self.inputs()))

    def test_a_nan_before_the_memory_does_not_matter(self, trained: Path) -> None:
        landmarks, images = self.inputs()
        landmarks[:, :2] = np.nan
        assert np.isfinite(
            LearnedPredictor.load(trained).predict(landmarks, images, 2).landmarks
        ).all()


class TestDamage:
    @pytest.fixture
    def folder(self, trained: Path, tmp_path: Path) -> Path:
        return Path(shutil.copytree(trained, tmp_path / "copy"))

    def refused(self, folder: Path, words: str) -> None:
        with pytest.raises(RequestError, match=words) as error:
            LearnedPredictor.load(folder)
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
    @pytest.mark.parametrize("how", ["gone", "short", "changed", "empty"])
    def test_files(self, folder: Path, name: str, how: str) -> None:
        path = folder / name
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        if how == "gone":
            path.unlink()
        elif how == "empty":
            path.write_bytes(b"")
        elif how == "changed":
            place = len(data) - 60 if name == "model.safetensors" else data.index(b'"width"') + 2
            path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        self.refused(folder, name.replace(".", r"\."))

    @pytest.mark.parametrize(
        ("key", "value", "words"),
        [
            ("schema", "other", "schema 'other' version 1, this release reads 'face_predictor' 1"),
            ("version", 2, "version 2, this release reads 'face_predictor' 1"),
            ("model", "gpt", "model 'gpt': unknown; valid: image_only"),
            ("model_sha256", "0", "are of different steps"),
        ],
    )
    def test_the_record(self, folder: Path, key: str, value, words: str) -> None:
        path = folder / "config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
        self.refused(folder, words)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda t: t.pop("future"), "tensor 'future' is missing"),
            (lambda t: t.update(more=torch.zeros(1)), "tensor 'more' is none of this network"),
            (lambda t: t.update(future=torch.zeros(3, 16)), r"'future' is torch.float32 \(3, 16\)"),
            (lambda t: t.update(future=t["future"].double()), "'future' is torch.float64"),
        ],
    )
    def test_tensors_of_another_network(self, folder: Path, change, words: str) -> None:
        state, record, _ = read_tensors(folder / "model.safetensors")
        change(state)
        digest = write_tensors(folder / "model.safetensors", state, record)
        path = folder / "config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "model_sha256": digest}))
        self.refused(folder, words)

    def test_a_damaged_trainer_file_is_refused_when_carrying_on(self, finished, folder) -> None:
        path = folder / "trainer.safetensors"
        data = path.read_bytes()
        path.write_bytes(data[:-200])
        with pytest.raises(RequestError, match=r"trainer\.safetensors: damaged"):
            run_train(replace(finished, out=folder))

    def test_everybody_may_read_the_files(self, folder: Path) -> None:
        mask = os.umask(0)
        os.umask(mask)
        for name in ("model.safetensors", "config.json", "trainer.safetensors"):
            assert (folder / name).stat().st_mode & 0o777 == 0o666 & ~mask
