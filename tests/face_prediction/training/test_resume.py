"""Training that is killed or interrupted, and carried on to the last bit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from face_prediction.commands.train import run_train
from face_prediction.models.learned import read_tensors
from face_prediction.training import trainer as trainer_module
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.windows import WindowBatch
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import read_metrics

pytestmark = pytest.mark.long
quick = pytest.mark.usefixtures("no_curves")


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


class KilledError(Exception):
    pass


@quick
def test_killed_and_carried_on_is_the_same_to_the_last_bit(
    options, whole, before_step, monkeypatch
) -> None:
    save = trainer_module.save_predictor_checkpoint
    moments = iter((7, 7, 11))
    deadline = next(moments)

    def die(step: int, batch: WindowBatch) -> None:
        if step == deadline:
            raise KilledError

    before_step(die)
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
    before_step(lambda step, batch: None)
    monkeypatch.setattr(trainer_module, "save_predictor_checkpoint", dying_save)
    with pytest.raises(KilledError):
        run_train(replace(options, checkpoint_every=1))
    monkeypatch.setattr(trainer_module, "save_predictor_checkpoint", save)
    assert run_train(options) == 0
    require_same_run(options.folder, whole)


@quick
def test_an_extended_run_is_the_longer_run(options) -> None:
    """8 is a multiple of the interval of validation; the learning rate is that of no budget."""
    options = replace(options, schedule="constant")
    whole = replace(options, out=options.folder.with_name("whole"))
    assert run_train(whole) == 0
    assert run_train(replace(options, steps=8)) == 0
    assert run_train(options) == 0
    for name in ("model.safetensors", "trainer.safetensors"):
        assert same(tensors(options.folder, name), tensors(whole.folder, name))
    written = [folder / "config.json" for folder in (options.folder, whole.folder)]
    assert written[0].read_text() == written[1].read_text()
    with pytest.raises(RequestError, match="has done 12 steps already, more than --steps 9"):
        run_train(replace(options, steps=9))
    with pytest.raises(RequestError, match=r"with training\.batch_size 3, not 2"):
        run_train(replace(options, steps=20, batch_size=2))


SCRIPT = """
import json, logging, sys
from pathlib import Path
logging.basicConfig(level=logging.INFO)
from face_prediction.commands.train import run_train
from face_prediction.training.options import FaceTrainOptions
given = json.loads(sys.argv[1])
given |= {name: Path(given[name]) for name in ("dataset", "out")}
sys.exit(run_train(FaceTrainOptions(**given)))
"""


def start(options: FaceTrainOptions, repository: Path) -> subprocess.Popen:
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
    (options.folder / ".model.safetensors.99999999.partial").touch()  # killed while writing
    assert run_train(options) == 0
    whole = replace(options, out=options.folder.with_name("whole"))
    assert run_train(whole) == 0
    require_same_run(options.folder, whole.folder)
    assert not list(options.folder.glob("*.partial"))


@quick
def test_ctrl_c_and_the_same_command_again(options, whole: Path, before_step) -> None:
    def interrupt(step: int, batch: WindowBatch) -> None:
        if step == 7:
            os.kill(os.getpid(), signal.SIGINT)

    before_step(interrupt)
    assert run_train(options) == 130
    _, state, _ = read_tensors(options.folder / "trainer.safetensors")
    assert state["progress"]["step"] == 8
    assert run_train(options) == 0
    require_same_run(options.folder, whole)


@quick
def test_ctrl_c_in_the_last_step_is_no_interruption(
    options, whole: Path, before_step, caplog
) -> None:
    caplog.set_level("INFO")

    def interrupt(step: int, batch: WindowBatch) -> None:
        if step == options.steps - 1:
            os.kill(os.getpid(), signal.SIGINT)

    before_step(interrupt)
    assert run_train(options) == 0
    assert f"{options.folder}: done" in caplog.text
    require_same_run(options.folder, whole)
