"""``metrics.jsonl``: each number once, whatever was cut off."""

from __future__ import annotations

import builtins
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import MetricsLog, open_board, read_metrics
from robo_manip_baselines.training.state import RunningMean


class Board:
    def __init__(self) -> None:
        self.shown: list[tuple[str, float, int]] = []

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        self.shown.append((tag, scalar_value, global_step))

    def close(self) -> None:
        self.shown.append(("closed", 0.0, 0))


def test_running_mean() -> None:
    mean = RunningMean()
    for value in (1.0, 2.0, 6.0):
        mean.add({"loss": torch.tensor(value), "kl": torch.tensor(-value)})
    assert (mean.names, mean.means().tolist()) == (("loss", "kl"), [3.0, -3.0])
    mean.reset()
    mean.add({"loss": torch.tensor(5.0), "kl": torch.tensor(0.0)})
    assert mean.means().tolist() == [5.0, 0.0]


def test_lines_are_written_at_once_and_shown(tmp_path: Path) -> None:
    board = Board()
    log = MetricsLog(tmp_path / "metrics.jsonl", 0, board)
    log.write("train", 5, {"loss": 0.123456789, "grad_norm": float("inf")})
    # seven digits; JSON has no infinity
    assert read_metrics(tmp_path / "metrics.jsonl") == [
        {"kind": "train", "step": 5, "loss": 0.1234568}
    ]
    log.close()
    assert board.shown == [("train/loss", 0.123456789, 5), ("closed", 0.0, 0)]


@pytest.mark.parametrize("torn", ["", '{"kind": "train", "st', "\x00\x00"])
def test_going_on_drops_what_comes_later(tmp_path: Path, torn: str) -> None:
    path = tmp_path / "metrics.jsonl"
    lines = [{"kind": kind, "step": step} for step in (2, 4, 6) for kind in ("train", "validation")]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + torn)
    log = MetricsLog(path, 4, None)
    log.write("train", 6, {"loss": 1.0})
    log.close()
    assert read_metrics(path) == [*lines[:4], {"kind": "train", "step": 6, "loss": 1.0}]


def test_no_file_is_no_lines(tmp_path: Path) -> None:
    assert read_metrics(tmp_path / "metrics.jsonl") == []


@pytest.mark.long
def test_tensorboard_writes_a_file(tmp_path: Path) -> None:
    board = open_board("tensorboard", tmp_path, 0, {})
    assert board is not None
    board.add_scalar("train/loss", 1.0, 1)
    board.close()
    assert list((tmp_path / "tensorboard").glob("events.out.*"))


def test_no_board(tmp_path: Path) -> None:
    assert open_board("none", tmp_path, 0, {}) is None


def test_wandb_that_is_not_installed_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def fake(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "wandb":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", fake)
    with pytest.raises(RequestError, match=r"wandb is not installed.*pip install wandb"):
        open_board("wandb", tmp_path, 0, {})
    with pytest.raises(RequestError, match="unknown logger 'paper'; valid: none, tensorboard"):
        open_board("paper", tmp_path, 0, {})
