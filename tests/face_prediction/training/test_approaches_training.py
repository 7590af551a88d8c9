"""The comparison of the paper's approaches, with the real trainer on a small dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from face_prediction.training import trainer as trainer_module
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import read_metrics

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("no_curves")]

TINY = ("width=16", "heads=2", "layers=1", "feedforward=16", "history=6", "horizon=2")


@pytest.fixture
def approaches(
    load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> ModuleType:
    return load_script("benchmarks/approaches.py")


def test_an_interrupted_training_is_finished_and_other_settings_are_refused(
    approaches: ModuleType,
    dataset: Path,
    tmp_path: Path,
    before_step: Callable[[Any], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options = approaches.Options(
        *(dataset, ("cross_attention",)),
        settings=TINY,
        steps=8,
        batch_size=3,
        validate_every=2,
        out=tmp_path,
    )
    training = approaches.Training("cross_attention", "person", 0, 1e-3, augment=True)
    folder = tmp_path / "runs" / training.name

    def last_step() -> int:
        return max(line["step"] for line in read_metrics(folder / "metrics.jsonl"))

    class Stopped(StopRequest):
        def __enter__(self) -> StopRequest:
            def stop(step: int, batch: object) -> None:
                self.is_made = step == 4

            before_step(stop)
            return self

    with monkeypatch.context() as patched:
        patched.setattr(trainer_module, "StopRequest", Stopped)
        with pytest.raises(RequestError, match="interrupted; the same command carries on"):
            approaches.train(options, training)
    before_step(lambda step, batch: None)
    assert read_json(folder / "config.json")["training"]["steps"] == 8
    assert last_step() == 4

    fewer = replace(options, steps=6)
    assert approaches.train(fewer, training) == folder  # goes on to the 8 that it was begun with
    assert last_step() == 8
    weights = (folder / "model.safetensors").read_bytes()
    assert approaches.train(options, training) == folder
    assert (folder / "model.safetensors").read_bytes() == weights

    with pytest.raises(RequestError, match=r"holds a run with training\.batch_size 3, not 2"):
        approaches.train(replace(options, batch_size=2), training)
    with pytest.raises(RequestError, match=r"holds a run with settings\.size 32, not 64"):
        approaches.train(replace(options, size=64), training)
