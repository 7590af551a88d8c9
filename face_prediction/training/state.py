"""``trainer.safetensors``: everything that training needs to go on exactly, in one file.

Tensors are named ``weights/NAME``, ``average/NAME`` (where there is one), ``best/NAME`` (the
weights that did best on the fold held out) and ``adam/PARAMETER/KEY``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from face_prediction.errors import RequestError
from face_prediction.models.checkpoint import fill
from face_prediction.models.tensor_file import read_tensors, write_tensors
from face_prediction.training.step import TrainStep

SCHEMA = "face_trainer"
VERSION = 1
TRAINER_FILE = "trainer.safetensors"


@dataclass
class Progress:
    """How far a run has come."""

    step: int = 0
    #: spent on it, by all processes that took part in turn
    seconds: float = 0.0
    #: names and rows of the numbers since the last line of ``metrics.jsonl``
    names: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    #: the step whose weights did best on the fold held out, and what they got
    best_step: int | None = None
    best: dict[str, float] = field(default_factory=dict)


def save_state(
    folder: Path,
    run: Mapping[str, Any],
    train_step: TrainStep,
    progress: Progress,
    best: Mapping[str, Tensor],
) -> None:
    """Write the file, whole or not at all; ``run`` says what is trained, for `read_state`."""
    tensors = _prefixed("weights/", train_step.model.state_dict())
    if train_step.average is not None:
        tensors |= _prefixed("average/", train_step.average.state_dict())
    tensors |= _prefixed("best/", best)
    for name, parameter in train_step.model.named_parameters():
        tensors |= _prefixed(f"adam/{name}/", train_step.optimizer.state.get(parameter, {}))
    record = {
        "schema": SCHEMA,
        "version": VERSION,
        "run": dict(run),
        "progress": asdict(progress),
    }
    write_tensors(folder / TRAINER_FILE, tensors, record)


def read_state(path: Path) -> tuple[dict[str, Tensor], dict[str, Any], Progress]:
    """Tensors, what is trained, and how far it has come.

    Raises:
        RequestError: the file is damaged or of another kind.
    """
    tensors, record, _ = read_tensors(path)
    if (record.get("schema"), record.get("version")) != (SCHEMA, VERSION):
        raise RequestError(
            f"{path}: schema '{record.get('schema')}' version {record.get('version')}, "
            f"expected '{SCHEMA}' {VERSION}; choose another --out"
        )
    return tensors, record["run"], Progress(**record["progress"])


@torch.no_grad()
def restore(train_step: TrainStep, tensors: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Put a fresh `TrainStep` where another one was; the best weights so far are returned.

    Raises:
        RequestError: the tensors are not those of this network.
    """
    fill(train_step.model, _without("weights/", tensors), path)
    if train_step.average is not None:
        fill(train_step.average, _without("average/", tensors), path)
    for name, parameter in train_step.model.named_parameters():
        moments = _without(f"adam/{name}/", tensors)
        if moments:
            train_step.optimizer.state[parameter] = {
                # Adam keeps its count of steps on the CPU
                key: value if key == "step" else value.to(parameter.device)
                for key, value in moments.items()
            }
    return _without("best/", tensors)


def result(tensors: Mapping[str, Tensor], progress: Progress) -> tuple[dict[str, Tensor], int]:
    """The weights that a run is made for, and the step that made them.

    The best, where a fold is held out; else the last, averaged where there is an average.
    """
    if progress.best_step is not None:
        return _without("best/", tensors), progress.best_step
    return _without("average/", tensors) or _without("weights/", tensors), progress.step


def _prefixed(prefix: str, tensors: Mapping[str, Any]) -> dict[str, Tensor]:
    return {f"{prefix}{name}": tensor for name, tensor in tensors.items()}


def _without(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }
