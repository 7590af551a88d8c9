"""``train`` on a small drawn dataset: what it leaves, and what it refuses."""

from __future__ import annotations

import logging
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from face_prediction.commands.train import run_train
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import split_dataset
from face_prediction.models.learned import (
    LearnedPredictor,
    read_predictor_checkpoint,
    read_tensors,
    write_tensors,
)
from face_prediction.prediction.errors import mouth_distances, mouth_residuals
from face_prediction.tracking.geometry import LIPS
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.trainer import choose_people
from face_prediction.training.windows import WindowBatch
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked
from robo_manip_baselines.runs.metrics import read_metrics

pytestmark = pytest.mark.long
NETWORK = ("model.safetensors", "config.json")
quick = pytest.mark.usefixtures("no_curves")


def tensors(folder: Path, name: str = "model.safetensors") -> dict[str, torch.Tensor]:
    return read_tensors(folder / name)[0]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def changed(options: FaceTrainOptions, change: dict) -> FaceTrainOptions:
    """Other options; ``settings`` are added to those there are."""
    more = {"settings": (*options.settings, *change["settings"])} if "settings" in change else {}
    return replace(options, **{**change, **more})


def test_the_dataset_shows_what_it_says(dataset: Path) -> None:
    with FaceDataset(dataset) as faces:
        sequence = faces.read(3)
    red = sequence.images[..., 0].astype(float) - sequence.images[..., 1] > 80
    seen = np.array([np.argwhere(frame).mean(axis=0)[::-1] + 0.5 for frame in red]) / 64
    expected = sequence.landmarks[:, list(LIPS), :2].mean(axis=1)
    np.testing.assert_allclose(seen, expected, atol=1.5 / 64)


@quick
def test_a_split_by_sequence(options: FaceTrainOptions, dataset: Path, monkeypatch, caplog) -> None:
    caplog.set_level(logging.INFO)
    options = replace(options, split="sequence", test_fold=9, steps=1, validate_every=1)
    assert replace(options, out=None).folder.name == "cross_attention_cpu_sequence9_seed0"
    assert run_train(options) == 0
    record, _ = read_predictor_checkpoint(options.folder)
    assert record.split == "sequence"
    assert record.folds == {"train": [*range(1, 9)], "validation": [0], "test": [9]}
    assert {"ann", "bob", "eve"} <= set(record.train_subjects)  # in all parts
    with FaceDataset(dataset) as opened:
        split = split_dataset(opened, "sequence")
        used = choose_people(opened, options)
    assert record.windows_sha256 == split.windows_sha256
    assert used.train.tolist() == split.training({9, 0}).tolist()
    assert used.validation.tolist() == split.members({0}).tolist()
    with pytest.raises(RequestError, match="holds a run with split sequence, not person; choose"):
        run_train(replace(options, split="person", test_fold=0))
    with pytest.raises(RequestError, match="leaves a part for the report; valid: 0 to 9"):
        run_train(replace(options, test_fold=None, hold_out="none"))
    with pytest.raises(RequestError, match="fold 10: this dataset has folds 0 to 9"):
        run_train(replace(options, test_fold=10))


@quick
def test_a_run_of_a_release_without_splits_is_carried_on(options: FaceTrainOptions) -> None:
    options = replace(options, steps=1)
    assert run_train(options) == 0
    state, record, _ = read_tensors(options.folder / "trainer.safetensors")
    for name in ("split", "windows_sha256"):
        del record["run"][name]
    del record["run"]["settings"]["residual"]
    write_tensors(options.folder / "trainer.safetensors", state, record)
    with pytest.raises(RequestError, match=r"with settings\.residual False, not True"):
        run_train(replace(options, settings=(*options.settings, "residual=true")))
    assert run_train(replace(options, steps=2)) == 0


@pytest.mark.parametrize("model", ["image_only", "simple_fusion", "cross_attention"])
def test_what_training_leaves(options: FaceTrainOptions, dataset: Path, model) -> None:
    options = replace(options, model=model)
    assert run_train(options) == 0
    names = {path.name for path in options.folder.iterdir()}
    assert names == {
        "model.safetensors", "config.json", "trainer.safetensors", "metrics.jsonl", "curves.png",
        ".lock",
    }  # fmt: skip
    record, _ = read_predictor_checkpoint(options.folder)
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
    images = np.stack([row.images for row in rows])
    forecast = predictor.predict(points[:, :8], images[:, 2:8], 2)
    still = np.repeat(points[:, 7:8], 2, axis=1)
    expected = mouth_distances(mouth_residuals(still, points[:, 8:])).mean()
    assert record.validation["persistence_mouth_error"] == pytest.approx(expected, rel=1e-5)
    assert forecast.images is not None
    change = (forecast.images.astype(float) - images[:, 8:]) / 255
    assert record.validation["image"] == pytest.approx((change**2).mean(), rel=0.02)  # rounded
    change = (images[:, 7:8].astype(float) - images[:, 8:]) / 255
    assert record.validation["copy_image"] == pytest.approx((change**2).mean(), rel=1e-5)
    if model == "image_only":
        assert np.isnan(forecast.landmarks).all()
    else:
        error = mouth_distances(mouth_residuals(forecast.landmarks, points[:, 8:])).mean()
        assert record.validation["mouth_error"] == pytest.approx(error, rel=1e-4)


@quick
def test_a_finished_run_says_so_and_changes_nothing(options, whole: Path, caplog) -> None:
    caplog.set_level(logging.INFO)
    options = replace(options, out=whole)
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


def test_help_does_not_load_torch(repository: Path) -> None:
    script = (
        "import sys\nfrom face_prediction.commands.cli import main\n"
        "try: main(['train', '--help'])\nexcept SystemExit: pass\n"
        "sys.exit('torch' in sys.modules)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script], cwd=repository, capture_output=True, text=True, check=True
    )
    assert "Example: face-prediction train cross_attention" in result.stdout
    assert "--validation_sequences" in result.stdout


def test_without_torch_it_says_what_to_install(options, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "face_prediction.training.trainer")
    with pytest.raises(RequestError, match="pip install"):
        run_train(options)


@quick
def test_holding_nobody_out_keeps_the_last_weights(options) -> None:
    options = replace(options, hold_out="none", ema_decay=0.0)
    assert run_train(options) == 0
    record, state = read_predictor_checkpoint(options.folder)
    assert record.step == 12
    assert record.folds == {"train": [1, 2], "validation": [], "test": [0]}
    assert record.train_subjects == ["cat", "dan", "eve"]
    assert record.validation == {}
    kept = tensors(options.folder, "trainer.safetensors")
    assert same(state, {k[8:]: v for k, v in kept.items() if k.startswith("weights/")})
    assert not any(name.startswith(("best/", "average/")) for name in kept)


@quick
def test_seeds_and_data_make_the_weights(finished: FaceTrainOptions, tmp_path: Path) -> None:
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
        ({"seed": 3}, "seed 0, not 3"),
        ({"settings": ("width=8",)}, "settings.width 16, not 8"),
        ({"hold_out": "none"}, "folds.train"),
        ({"model": "simple_fusion"}, "model cross_attention, not simple_fusion"),
    ],
)
def test_a_folder_of_another_run_is_refused(finished, change, words: str) -> None:
    with pytest.raises(RequestError, match=words) as refused:
        run_train(changed(finished, change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dataset": Path("absent")}, "absent: no dataset"),
        ({"test_fold": 3}, "fold 3: this dataset has folds 0 to 2"),
        ({"settings": ("history=9",)}, "sequences of 8 . 2 frames"),
        ({"settings": ("horizon=3",)}, "needs 6 . 3"),
        ({"settings": ("size=128",)}, "64 pixels, but this network needs 128"),
        ({"settings": ("width",)}, "--settings 'width': must be NAME=VALUE"),
        ({"steps": 0}, "--steps 0"),
        ({"seed": -1}, "--seed -1: must be 0 to"),
        ({"memory_gb": float("nan")}, "--memory_gb nan"),
        ({"checkpoint_every": 0}, "--checkpoint_every 0"),
        ({"device": "gpu"}, "--device gpu"),
    ],
)
def test_what_cannot_be_trained_is_refused(options, change, words: str) -> None:
    with pytest.raises(RequestError, match=words):
        run_train(changed(options, change))
    assert not (options.folder / "model.safetensors").exists()


@quick
def test_a_damaged_picture_is_refused_by_name(options, tmp_path, make_faces) -> None:
    folder = make_faces(tmp_path / "faces")
    path = folder / "clips" / "dan.h5"
    data = bytearray(path.read_bytes())
    middle = data.index(b"\xff\xd8\xff", len(data) // 3) + 300  # inside a JPEG picture
    data[middle] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(RequestError, match=r"dan\.h5.*damaged"):
        run_train(replace(options, dataset=folder))


@quick
def test_a_folder_that_is_in_use_is_refused(options) -> None:
    with locked(options.folder), pytest.raises(RequestError, match="another process"):
        run_train(options)
    assert run_train(replace(options, steps=1)) == 0


@quick
def test_a_network_without_its_trainer_is_not_overwritten(finished, options) -> None:
    shutil.copytree(finished.folder, options.folder)
    (options.folder / "trainer.safetensors").unlink()
    with pytest.raises(RequestError, match=r"no trainer\.safetensors"):
        run_train(options)


@quick
@pytest.mark.parametrize("validate_every", [4, 12])
def test_weights_that_are_not_finite_are_not_saved(options, before_step, validate_every) -> None:
    """At step 8 the held-out error is the first to tell, else the mean loss at step 9."""

    def explode(step: int, batch: WindowBatch) -> WindowBatch | None:
        future = replace(batch.future, landmarks=batch.future.landmarks * float("nan"))
        return None if step < 6 else batch._replace(future=future)

    before_step(explode)
    with pytest.raises(RequestError, match=r"not finite.*the state of step 5 is kept"):
        run_train(replace(options, validate_every=validate_every))
    _, state, _ = read_tensors(options.folder / "trainer.safetensors")
    assert state["progress"]["step"] == 5
