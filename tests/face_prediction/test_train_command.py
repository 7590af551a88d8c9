"""``train`` on a small drawn dataset: what it leaves, carrying on exactly, and what it refuses."""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from face_prediction.dataset.clip_file import EncodedPictures, write_clip
from face_prediction.dataset.facts import sequence_facts
from face_prediction.dataset.manifest import ClipEntry, Manifest, write_manifest
from face_prediction.dataset.pictures import encode_picture
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import clip_frames, find_sequences
from face_prediction.dataset.settings import SequenceSettings
from face_prediction.errors import RequestError
from face_prediction.evaluation import mouth_distances, mouth_residuals
from face_prediction.lifting import LIPS
from face_prediction.models.checkpoint import read_checkpoint
from face_prediction.models.interface import History
from face_prediction.models.learned import LearnedPredictor
from face_prediction.models.tensor_file import read_tensors, write_tensors
from face_prediction.train_command import TrainOptions, run_train
from face_prediction.training import job
from face_prediction.training import trainer as trainer_module
from face_prediction.training.metrics import read_metrics
from face_prediction.training.run_folder import locked
from face_prediction.training.step import TrainStep

pytestmark = pytest.mark.long
NETWORK = ("model.safetensors", "config.json")
quick = pytest.mark.usefixtures("no_curves")

SEQUENCES = SequenceSettings(history=8, future=2, stride=4, crop_size=64)
PEOPLE = {"ann": 0, "bob": 0, "cat": 1, "dan": 2, "eve": 2}
SETTINGS = (
    "size=32",
    "channels=[4, 8]",
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
        pictures.append(encode_picture(picture, 95))
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
            EncodedPictures(encoded, index),
            sequence_facts(frames, sequences, SEQUENCES),
            {**record, "settings": SEQUENCES.to_json()},
        )
        entries.append(entry)
    write_manifest(folder, Manifest(SEQUENCES, folds=3, seed=0, clips=tuple(entries)))
    return folder


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, make_track) -> Path:
    return make_dataset(tmp_path_factory.mktemp("faces"), make_track)


def twelve_steps(dataset: Path, out: Path) -> TrainOptions:
    return TrainOptions(
        model="cross_attention", dataset=dataset, out=out, settings=SETTINGS,
        steps=12, batch_size=3, validate_every=4, warmup_steps=2, ema_decay=0.5, augment=True,
        log_every=3, checkpoint_every=5, progress=False, device="cpu",
    )  # fmt: skip


@pytest.fixture
def options(dataset: Path, tmp_path: Path) -> TrainOptions:
    return twelve_steps(dataset, tmp_path / "run")


@pytest.fixture(scope="module")
def whole(dataset: Path, tmp_path_factory) -> Path:
    """What the options leave when nothing comes between."""
    options = twelve_steps(dataset, tmp_path_factory.mktemp("runs") / "whole")
    assert run_train(options) == 0
    return options.folder


@pytest.fixture(scope="module")
def finished(dataset: Path, tmp_path_factory) -> TrainOptions:
    """The options of a short run that is done; its folder is not to be changed."""
    options = TrainOptions(
        model="cross_attention", dataset=dataset, out=tmp_path_factory.mktemp("runs") / "run",
        settings=SETTINGS, steps=1, batch_size=2, progress=False, device="cpu",
    )  # fmt: skip
    run_train(options)
    return options


@pytest.fixture
def trained(finished: TrainOptions) -> Path:
    """The folder of a network; not to be changed."""
    return finished.folder


@pytest.fixture
def no_curves(monkeypatch) -> None:
    """Drawing takes longer than these trainings."""
    monkeypatch.setattr(job, "draw_curves", lambda folder: None)


def tensors(folder: Path, name: str = "model.safetensors") -> dict[str, torch.Tensor]:
    return read_tensors(folder / name)[0]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def without_time(folder: Path) -> list[dict]:
    lines = read_metrics(folder / "metrics.jsonl")
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]


def require_same_run(ours: Path, theirs: Path) -> None:
    """Weights, moments, averages and metrics alike, to the last bit."""
    for name in ("model.safetensors", "trainer.safetensors"):
        assert same(tensors(ours, name), tensors(theirs, name))
    assert without_time(ours) == without_time(theirs)
    assert (ours / "config.json").read_text() == (theirs / "config.json").read_text()


def test_the_dataset_shows_what_it_says(dataset: Path) -> None:
    with FaceDataset(dataset) as faces:
        sequence = faces.read(3)
    red = sequence.pictures[..., 0].astype(float) - sequence.pictures[..., 1] > 80
    seen = np.array([np.argwhere(frame).mean(axis=0)[::-1] + 0.5 for frame in red]) / 64
    expected = sequence.landmarks[:, list(LIPS), :2].mean(axis=1)
    np.testing.assert_allclose(seen, expected, atol=1.5 / 64)


@pytest.mark.parametrize("model", ["image_only", "simple_fusion", "cross_attention"])
def test_what_training_leaves(options: TrainOptions, dataset: Path, model) -> None:
    options = replace(options, model=model)
    assert run_train(options) == 0
    names = {path.name for path in options.folder.iterdir()}
    assert names == {
        "model.safetensors", "config.json", "trainer.safetensors", "metrics.jsonl", "curves.png",
        ".lock",
    }  # fmt: skip
    record, _ = read_checkpoint(options.folder)
    assert (record.model, record.preset, record.seed) == (model, "cpu", 0)
    assert record.settings["width"] == 16
    assert record.training["steps"] == 12
    assert record.folds == {"train": [2], "validation": [1], "test": [0]}
    assert record.train_subjects == ["dan", "eve"]
    assert record.dataset["history"] == 8
    assert len(record.dataset_sha256) == 64
    lines = read_metrics(options.folder / "metrics.jsonl")
    assert [(x["kind"], x["step"]) for x in lines] == [
        ("train", 3), ("validation", 4), ("train", 6), ("validation", 8), ("train", 9),
        ("train", 12), ("validation", 12),
    ]  # fmt: skip
    key = "loss" if model == "image_only" else "mouth_error"
    looks = [line for line in lines if line["kind"] == "validation"]
    best = min(looks, key=lambda line: line[key])
    assert record.step == best["step"]
    assert record.validation[key] == pytest.approx(best[key], rel=1e-6)

    # the weights that were kept give the error that is written beside them
    predictor = LearnedPredictor.load(options.folder)
    with FaceDataset(dataset) as faces:
        rows = [faces.read(int(i), reduce=2) for i in faces.indices(folds={1})]
    points = np.stack([row.landmarks[..., :2] for row in rows])
    pictures = np.stack([row.pictures for row in rows])
    forecast = predictor.predict(points[:, :8], pictures[:, 2:8], 2)
    still = np.repeat(points[:, 7:8], 2, axis=1)
    expected = mouth_distances(mouth_residuals(still, points[:, 8:])).mean()
    assert record.validation["persistence_mouth_error"] == pytest.approx(expected, rel=1e-5)
    assert forecast.pictures is not None
    change = (forecast.pictures.astype(float) - pictures[:, 8:]) / 255
    assert record.validation["image"] == pytest.approx((change**2).mean(), rel=0.02)  # rounded
    change = (pictures[:, 7:8].astype(float) - pictures[:, 8:]) / 255
    assert record.validation["copy_image"] == pytest.approx((change**2).mean(), rel=1e-5)
    if model == "image_only":
        assert np.isnan(forecast.landmarks).all()
    else:
        error = mouth_distances(mouth_residuals(forecast.landmarks, points[:, 8:])).mean()
        assert record.validation["mouth_error"] == pytest.approx(error, rel=1e-4)


class KilledError(Exception):
    pass


@quick
def test_killed_and_carried_on_is_the_same_to_the_last_bit(options, whole, monkeypatch) -> None:
    step, save = TrainStep.__call__, trainer_module.save_checkpoint
    moments = iter((7, 7, 11))
    deadline = next(moments)

    def dying_step(self, batch, number):
        if number == deadline:
            raise KilledError
        return step(self, batch, number)

    monkeypatch.setattr(TrainStep, "__call__", dying_step)
    for following in moments:
        with pytest.raises(KilledError):
            run_train(options)
        deadline = following

    # the last one: between the trainer's file and the network's
    def dying_save(folder, record, state):
        if record.validation and deadline == 11:
            raise KilledError
        save(folder, record, state)

    deadline = 11
    monkeypatch.setattr(TrainStep, "__call__", step)
    monkeypatch.setattr(trainer_module, "save_checkpoint", dying_save)
    with pytest.raises(KilledError):
        run_train(replace(options, checkpoint_every=1))
    monkeypatch.setattr(trainer_module, "save_checkpoint", save)
    assert run_train(options) == 0
    require_same_run(options.folder, whole)


SCRIPT = """
import json, logging, sys
from pathlib import Path
logging.basicConfig(level=logging.INFO)
from face_prediction.train_command import TrainOptions, run_train
given = json.loads(sys.argv[1])
given |= {name: Path(given[name]) for name in ("dataset", "out")}
sys.exit(run_train(TrainOptions(**given)))
"""


def start(options: TrainOptions, repository: Path) -> subprocess.Popen:
    words = json.dumps(vars(options), default=str)
    return subprocess.Popen([sys.executable, "-c", SCRIPT, words], cwd=repository)


def wait_for_step(folder: Path, step: int, process: subprocess.Popen) -> None:
    while process.poll() is None:
        if any(line["step"] >= step for line in read_metrics(folder / "metrics.jsonl")):
            return
        time.sleep(0.05)
    raise AssertionError("it ended too early")


@quick
def test_a_kill_and_the_same_command_again(options, repository: Path) -> None:
    options = replace(options, steps=40, validate_every=15, log_every=1, checkpoint_every=7)
    process = start(options, repository)
    wait_for_step(options.folder, 12, process)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    _, state, _ = read_tensors(options.folder / "trainer.safetensors")
    assert 7 <= state["progress"]["step"] < 40
    (options.folder / ".model.safetensors.1.partial").touch()  # killed while writing
    assert run_train(options) == 0
    whole = replace(options, out=options.folder.with_name("whole"))
    assert run_train(whole) == 0
    require_same_run(options.folder, whole.folder)
    assert not list(options.folder.glob("*.partial"))


@quick
def test_ctrl_c_and_the_same_command_again(options, whole: Path, monkeypatch) -> None:
    step = TrainStep.__call__

    def interrupted(self, batch, number):
        if number == 7:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, batch, number)

    monkeypatch.setattr(TrainStep, "__call__", interrupted)
    assert run_train(options) == 130
    _, state, _ = read_tensors(options.folder / "trainer.safetensors")
    assert state["progress"]["step"] == 8
    assert run_train(options) == 0
    require_same_run(options.folder, whole)


@quick
def test_a_finished_run_says_so_and_changes_nothing(dataset, whole: Path, caplog) -> None:
    caplog.set_level(logging.INFO)
    options = twelve_steps(dataset, whole)
    before = {path: path.read_bytes() for path in options.folder.iterdir()}
    assert run_train(options) == 0
    assert "finished already, 12 steps" in caplog.records[-1].getMessage()
    assert {path: path.read_bytes() for path in options.folder.iterdir()} == before


@quick
@pytest.mark.parametrize("held", ["next", "none"])
def test_a_finished_run_whose_network_is_damaged_writes_it_again(options, held: str) -> None:
    options = replace(options, hold_out=held, steps=3)
    assert run_train(options) == 0
    before = {name: (options.folder / name).read_bytes() for name in NETWORK}
    for name in NETWORK:
        (options.folder / name).write_bytes(b"damaged")
        assert run_train(options) == 0
        assert {name: (options.folder / name).read_bytes() for name in NETWORK} == before


def test_without_torch_it_says_what_to_install(options, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "face_prediction.training.job")
    with pytest.raises(RequestError, match="pip install"):
        run_train(options)


@quick
def test_holding_nobody_out_keeps_the_last_weights(options) -> None:
    options = replace(options, hold_out="none", ema_decay=0.0)
    assert run_train(options) == 0
    record, state = read_checkpoint(options.folder)
    assert record.step == 12
    assert record.folds == {"train": [1, 2], "validation": [], "test": [0]}
    assert record.train_subjects == ["cat", "dan", "eve"]
    assert record.validation == {}
    kept = tensors(options.folder, "trainer.safetensors")
    assert same(state, {k[8:]: v for k, v in kept.items() if k.startswith("weights/")})
    assert not any(name.startswith(("best/", "average/")) for name in kept)


@quick
def test_seeds_and_data_make_the_weights(finished: TrainOptions, tmp_path: Path) -> None:
    first = tensors(finished.folder)
    changes = {"again": {}, "seed": {"seed": 1}, "people": {"subjects": 1}}
    for name, change in changes.items():
        given = replace(finished, out=tmp_path / name, **change)
        assert run_train(given) == 0
        assert same(first, tensors(given.folder)) == (name == "again")


@quick
def test_training_learns(options) -> None:
    """The dot's place is plain to see: the error falls well below that of the mean face."""
    options = replace(
        options, model="simple_fusion", steps=60, learning_rate=3e-3, validate_every=60,
        augment=False, log_every=10, ema_decay=0.0,
    )  # fmt: skip
    assert run_train(options) == 0
    losses = [x["loss"] for x in read_metrics(options.folder / "metrics.jsonl") if "gradient" in x]
    assert losses[-1] < 0.2 * losses[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"steps": 13}, "training.steps 1, not 13"),
        ({"seed": 3}, "seed 0, not 3"),
        ({"settings": (*SETTINGS, "width=8")}, "settings.width 16, not 8"),
        ({"hold_out": "none"}, "folds.train"),
        ({"model": "simple_fusion"}, "model cross_attention, not simple_fusion"),
    ],
)
def test_a_folder_of_another_run_is_refused(finished, change, words: str) -> None:
    with pytest.raises(RequestError, match=words) as refused:
        run_train(replace(finished, **change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dataset": Path("absent")}, "absent: no dataset"),
        ({"test_fold": 3}, "fold 3: this dataset has folds 0 to 2"),
        ({"settings": (*SETTINGS, "history=9")}, "sequences of 8 . 2 frames"),
        ({"settings": (*SETTINGS, "horizon=3")}, "needs 6 . 3"),
        ({"settings": (*SETTINGS, "size=128")}, "64 pixels, but this network needs 128"),
        ({"settings": ("width",)}, "--settings width: NAME=VALUE"),
        ({"steps": 0}, "--steps 0"),
        ({"seed": -1}, "--seed -1: 0 or more"),
        ({"memory_gb": float("nan")}, "--memory_gb nan"),
        ({"checkpoint_every": 0}, "--checkpoint_every 0"),
        ({"device": "gpu"}, "--device gpu"),
    ],
)
def test_what_cannot_be_trained_is_refused(options, change, words: str) -> None:
    with pytest.raises(RequestError, match=words):
        run_train(replace(options, **change))
    assert not (options.folder / "model.safetensors").exists()


@quick
def test_a_damaged_picture_is_refused_by_name(options, tmp_path, make_track) -> None:
    folder = make_dataset(tmp_path / "faces", make_track)
    path = folder / "clips" / "dan.h5"
    data = bytearray(path.read_bytes())
    middle = data.index(b"\xff\xd8\xff", len(data) // 3) + 300  # inside a JPEG picture
    data[middle] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(RequestError, match=r"dan\.h5.*damaged"):
        run_train(replace(options, dataset=folder))


@quick
def test_a_folder_that_is_in_use_is_refused(options) -> None:
    with locked(options.folder), pytest.raises(RequestError, match="another process trains here"):
        run_train(options)
    assert run_train(replace(options, steps=1)) == 0


@quick
def test_a_network_without_its_trainer_is_not_overwritten(finished, options) -> None:
    shutil.copytree(finished.folder, options.folder)
    (options.folder / "trainer.safetensors").unlink()
    with pytest.raises(RequestError, match=r"no trainer\.safetensors"):
        run_train(options)


@quick
def test_weights_that_are_not_finite_are_not_saved(options, monkeypatch) -> None:
    step = TrainStep.__call__

    def exploding(self, batch, number):
        numbers = step(self, batch, number)
        return numbers if number < 6 else {k: v * float("nan") for k, v in numbers.items()}

    monkeypatch.setattr(TrainStep, "__call__", exploding)
    with pytest.raises(RequestError, match=r"not finite.*the state of step 5 is kept"):
        run_train(options)
    _, state, _ = read_tensors(options.folder / "trainer.safetensors")
    assert state["progress"]["step"] == 5


class TestLearnedPredictor:
    def inputs(self, rows: int = 5) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(0)
        pictures = rng.integers(0, 256, (rows, 6, 32, 32, 3), dtype=np.uint8)
        return rng.uniform(0, 1, (rows, 8, 468, 2)), pictures

    def test_what_it_says_of_itself(self, trained: Path) -> None:
        predictor = LearnedPredictor.load(trained)
        assert predictor.name == "cross_attention"
        assert predictor.memory == 6
        assert (predictor.needs.frames, predictor.needs.size) == (6, 32)
        assert predictor.record.train_subjects == ["dan", "eve"]

    def test_batches_and_horizons(self, trained: Path) -> None:
        landmarks, pictures = self.inputs()
        whole = LearnedPredictor.load(trained).predict(landmarks, pictures, 2)
        assert whole.landmarks.shape == (5, 2, 468, 2)
        assert whole.landmarks.dtype == np.float32
        assert whole.pictures is not None
        assert whole.pictures.shape == (5, 2, 32, 32, 3)
        assert whole.pictures.dtype == np.uint8
        assert whole.mouth_scale is None
        parts = LearnedPredictor.load(trained, batch_size=2).predict(landmarks, pictures, 2)
        np.testing.assert_allclose(parts.landmarks, whole.landmarks, atol=1e-6)
        assert np.abs(parts.pictures.astype(int) - whole.pictures).max() <= 1  # pyright: ignore
        one = LearnedPredictor.load(trained).predict(landmarks[:, 2:], pictures, 1)
        np.testing.assert_allclose(one.landmarks, whole.landmarks[:, :1], atol=1e-6)

    def test_pictures_come_out_as_they_went_in(self, trained: Path) -> None:
        """Colours and rows in their places: the network's output against the array's."""
        predictor = LearnedPredictor.load(trained)
        landmarks, pictures = self.inputs(1)
        got = predictor.predict(landmarks, pictures, 2).pictures
        with torch.no_grad():
            history = History(
                torch.tensor(landmarks[:, 2:], dtype=torch.float32), torch.tensor(pictures)
            )
            out = predictor.model(history).pictures.numpy()
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
            (lambda x, p: (x, None, 1), "pictures: none"),
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
        landmarks, pictures = self.inputs()
        landmarks[:, :2] = np.nan
        assert np.isfinite(
            LearnedPredictor.load(trained).predict(landmarks, pictures, 2).landmarks
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
            ("schema", "other", "schema 'other' version 1, expected 'face_predictor' 1"),
            ("version", 2, "version 2, expected 'face_predictor' 1"),
            ("model", "gpt", "model 'gpt'; there are"),
            ("model_sha256", "0", "not of the same moment"),
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
