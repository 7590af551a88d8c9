"""``benchmarks/forecast_ablation.py``: what is done is kept, other weights are forecast again."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from face_prediction.evaluation.tracks import TRACK_GROUPS
from face_prediction.models.residual.predictor import ResidualPredictor
from robo_manip_baselines.runs.errors import RequestError


@pytest.fixture
def ablation(
    load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> ModuleType:
    """The script, with folders of text as weights: the error of the whole."""
    module = load_script("benchmarks/forecast_ablation.py")
    module.scored = []

    def load_predictor(folder: Path) -> tuple[Any, Any]:
        predictor = object.__new__(ResidualPredictor)
        predictor.fit = float((folder / "model.safetensors").read_text())  # type: ignore
        folds = {"train": [1], "validation": [], "test": [0]}
        return predictor, SimpleNamespace(model="residual", split="person", folds=folds)

    def score(error: float, stretches: list[Any], settings: object, names: list[str]):
        for name in names:
            module.scored.append((error, name))
            counts = {"sums": [error + (name != "nothing")] * len(TRACK_GROUPS)}
            yield name, [{"subject": "ann", "kind": "natural", **counts}]

    dataset = SimpleNamespace(manifest=SimpleNamespace(settings=None))
    stretch = SimpleNamespace(landmarks=np.zeros((3, 1, 2)), fold=0)
    monkeypatch.setattr(module, "load_predictor", load_predictor)
    monkeypatch.setattr(module, "score", score)
    monkeypatch.setattr(module, "FaceDataset", lambda path: contextlib.nullcontext(dataset))
    monkeypatch.setattr(module, "dataset_stretches", lambda dataset: [stretch])
    monkeypatch.setattr(module, "replace", lambda stretch, **changes: stretch)
    return module


def weights(folder: Path, error: float) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "model.safetensors").write_text(str(error))
    return folder


def run(ablation: ModuleType, monkeypatch: pytest.MonkeyPatch, out: Path, *folders: Path) -> None:
    words = ["--checkpoints", *map(str, folders), "--out", str(out), "--resamples", "10"]
    monkeypatch.setattr(sys, "argv", ["forecast_ablation.py", *words])
    ablation.main()


def test_a_line_that_was_cut_off_is_done_again(
    ablation: ModuleType, tmp_path: Path, monkeypatch, capsys
) -> None:
    folder, out = weights(tmp_path / "fold0", 1.0), tmp_path / "out.jsonl"
    run(ablation, monkeypatch, out, folder)
    page, whole = capsys.readouterr().out, out.read_bytes()
    assert "| natural | learning from the face | +100.0 (+100.0 to +100.0) |" in page
    out.write_bytes(whole[:-20])
    ablation.scored.clear()
    run(ablation, monkeypatch, out, folder)
    assert ablation.scored == [(1.0, ablation.variants()[-1])]
    assert out.read_bytes() == whole
    assert capsys.readouterr().out == page


def test_other_weights_and_lines_without_a_digest_are_done_again(
    ablation: ModuleType, tmp_path: Path, monkeypatch, capsys
) -> None:
    folder, out = weights(tmp_path / "fold0", 1.0), tmp_path / "out.jsonl"
    track = {"subject": "ann", "kind": "natural", "sums": [9.0] * len(TRACK_GROUPS)}
    earlier = {"without": "nothing", "fold": 0, "most_frames": 400, "tracks": [track]}
    out.write_text(json.dumps(earlier) + "\n")
    run(ablation, monkeypatch, out, folder)
    assert "| +100.0 (+100.0 to +100.0) |" in capsys.readouterr().out
    run(ablation, monkeypatch, out, weights(folder, 4.0))
    assert "| +25.0 (+25.0 to +25.0) |" in capsys.readouterr().out
    assert len(ablation.scored) == 2 * len(ablation.variants())
    run(ablation, monkeypatch, out, weights(folder, 1.0))  # whose lines are there
    assert "| +100.0 (+100.0 to +100.0) |" in capsys.readouterr().out
    assert len(ablation.scored) == 2 * len(ablation.variants())


def test_bad_requests(ablation: ModuleType, tmp_path: Path, monkeypatch) -> None:
    folder, out = weights(tmp_path / "fold0", 1.0), tmp_path / "out.jsonl"
    with pytest.raises(RequestError, match="two leave out the same fold"):
        run(ablation, monkeypatch, out, folder, folder)
    out.write_text("{]\n")
    with pytest.raises(RequestError, match="line 1"):
        run(ablation, monkeypatch, out, folder)
