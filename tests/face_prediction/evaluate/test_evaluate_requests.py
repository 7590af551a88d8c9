"""Requests that ``evaluate`` refuses: options, people trained on, other datasets and images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import face_prediction.commands.evaluate as command
from face_prediction.commands.cli import main
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import split_dataset
from face_prediction.evaluation.predictors import (
    FittedPredictor,
    load_network,
    require_strangers,
)
from robo_manip_baselines.runs.errors import RequestError

from .conftest import Toy, rows_of, run

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("checkpoints", "options", "message"),
    [
        (("reader_0", "idler_1"), {}, "no fold is covered by all checkpoints"),
        (
            (),
            {"kinds": ("nodding",)},
            "unknown kind of footage 'nodding'.*; valid: grid, head_motion, natural",
        ),
        ((), {"kinds": ("grid",)}, "no sequence of kind grid"),
        ((), {"baselines": ("best",)}, "unknown baseline 'best'; valid: ar_landmarks, "),
        ((), {"seed": -1}, "--seed -1: must be 0 to"),
        ((), {"warm_up": 500}, "--warm_up 500: no track is longer"),
        ((), {"max_sequences": 1}, "--max_sequences 1: must be 2 to 1000000000"),
        ((), {"detector_model": Path("absent.task")}, "--detector_model absent.task: no such"),
    ],
)
def test_bad_requests(dataset: Path, tmp_path: Path, toys, checkpoints, options, message) -> None:
    with pytest.raises(RequestError, match=message):
        run(dataset, tmp_path / "out", *checkpoints, **options)
    assert not (tmp_path / "out").exists()


def test_who_was_trained_on_is_not_judged_on(
    dataset: Path, tmp_path: Path, toys, monkeypatch
) -> None:
    monkeypatch.setattr(command, "fit_baselines", None)  # refused before anything takes time
    toys["reader_0"].train_subjects += ("ann", "bob", "cat", "dan", "eve")
    with pytest.raises(
        RequestError, match=r"reader: the predictor of fold 0 was trained on subject"
    ):
        run(dataset, tmp_path, "reader_0")
    toys["idler_0"].test_fold = 7
    with pytest.raises(RequestError, match=r"idler is for fold 7; .* has folds 0 to 1"):
        run(dataset, tmp_path, "idler_0")


def test_every_single_forecast_is_checked(dataset, tmp_path: Path, toys, monkeypatch) -> None:
    """Even where the check before all others has been forgotten."""
    monkeypatch.setattr(command, "require_unseen", lambda *_: None)
    toys["idler_1"].train_subjects += ("ann", "bob", "cat", "dan", "eve")
    with pytest.raises(RequestError, match="idler: the predictor of fold 1 was trained on subject"):
        run(dataset, tmp_path, "idler_1", max_sequences=2)


def test_a_network_for_other_pictures_is_refused(dataset: Path, tmp_path: Path, toys) -> None:
    toys["reader_0"].size = 256
    with pytest.raises(RequestError, match="images of 256 pixels: this dataset can give 64, 32"):
        run(dataset, tmp_path, "reader_0")


def test_a_dataset_with_one_fold_has_nobody_to_fit_to(dataset: Path, tmp_path: Path) -> None:
    root = dataset.parent
    words = ["build-dataset", root / "tracks", "--videos", root / "videos", "--folds", 1]
    words += ["--history", 8, "--future", 5, "--stride", 4, "--crop_size", 64, "--no_progress"]
    assert main([*map(str, words), "--out", str(tmp_path / "one")]) == 0
    with pytest.raises(RequestError, match=r"nobody is left to fit ar_mouth .*--baselines_from"):
        run(tmp_path / "one", tmp_path / "out", baselines=("ar_mouth",))
    # what has no parameters is there, and what was fitted to others
    record = run(tmp_path / "one", tmp_path / "out", baselines=("all",), tracks=False)
    assert set(rows_of(record)) == {"persistence", "constant_velocity", "line"}
    assert record["notes"] == ["One fold: only baselines without parameters are fitted to it."]
    with pytest.raises(RequestError, match="unknown baseline 'best'"):
        run(tmp_path / "one", tmp_path / "out", baselines=("best",), baselines_from=dataset)
    more = {"baselines": ("ar_mouth",), "baselines_from": dataset, "tracks": False}
    record = run(tmp_path / "one", tmp_path / "more", **more)
    assert set(rows_of(record)) == {"persistence", "ar_mouth (dataset)"}
    with pytest.raises(RequestError, match="is fitted to 5 of the 5 people"):  # themselves
        run(dataset, tmp_path / "both", baselines=("ar_mouth",), baselines_from=dataset)


@dataclass
class Record:
    """Fields that are read of a checkpoint's record."""

    dataset_sha256: str
    folds: dict
    train_subjects: tuple[str, ...] = ("ann", "zoe")
    preset: str = "fitted"
    settings: tuple = ()
    training: tuple = ()
    dataset: tuple = ()
    split: str = "person"


@pytest.mark.parametrize(
    ("digest", "tested", "found"), [("b", [1], 1), ("a", [1], None), ("b", [], None)]
)
def test_weights_are_for_a_fold_of_their_own_dataset_alone(
    dataset: Path, tmp_path: Path, monkeypatch, digest: str, tested: list[int], found: int | None
) -> None:
    loading = pytest.importorskip("face_prediction.models.loading")
    pytest.importorskip("torch", reason="PyTorch is not installed (extra face-prediction)")
    record = Record(64 * digest, {"test": tested})
    network = Toy("net", 0, ())
    monkeypatch.setattr(loading, "load_predictor", lambda folder: (network, record))
    (tmp_path / "model.safetensors").write_bytes(b"")
    with FaceDataset(dataset) as opened:
        fitted = load_network(tmp_path, "b" * 64, split_dataset(opened))
    assert fitted.checkpoint is not None
    assert fitted.checkpoint["test_fold"] == found
    assert fitted.subjects == {"ann", "zoe"}


def test_weights_of_elsewhere_must_know_nobody(dataset: Path) -> None:
    with FaceDataset(dataset) as opened:
        entry = {"name": "net", "folder": "far"}
        strangers = FittedPredictor(Toy("net", 0, ()), frozenset({"zoe"}), Path("far"), entry)
        assert require_strangers(opened, strangers) == (
            "net from far was trained on 1 people, of whose names none is among the 5 here."
        )
        known = replace(strangers, subjects=frozenset({"zoe", "bob", "ann"}))
        with pytest.raises(RequestError, match=r"far: was trained on 2 of the 5 .* \(ann, bob\)"):
            require_strangers(opened, known)
