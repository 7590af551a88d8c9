"""One step of training: forward, backward, Adam. No wait for the device."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from face_prediction.models.checkpoint import fill, read_tensors, write_tensors
from face_prediction.models.interface import PredictorModel
from face_prediction.models.settings import TrainSettings
from face_prediction.training.seeds import generator, torch_seed
from face_prediction.training.windows import Batch, augment
from robo_manip_baselines.runs.errors import RequestError


class TrainStep:
    """Carries out steps on a network, which it changes.

    Args:
        model: on its device, prepared.
        settings: of training.
        seed: of the run; dropout and augmentation are drawn from it and the step.

    Attributes:
        model: the network.
        average: the moving average of its weights, or None.
        optimizer: Adam (the paper's, IV.A).
    """

    def __init__(self, model: PredictorModel, settings: TrainSettings, seed: int) -> None:
        self.model = model
        self.average = copy.deepcopy(model).eval() if settings.ema_decay else None
        self.optimizer = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
        self.device = next(model.parameters()).device
        self._settings = settings
        self._seed = seed

    def __call__(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Train on a batch; the loss, its terms and the gradient's length, on the device."""
        settings = self._settings
        self.model.train()
        batch = batch.to(self.device)
        if settings.augment:
            batch = augment(batch, generator(self._seed, "augment", step))
        for group in self.optimizer.param_groups:
            group["lr"] = settings.learning_rate_at(step)
        torch.manual_seed(torch_seed(self._seed, "dropout", step))
        with self.autocast():
            losses = self.model.loss(*batch)
        self.optimizer.zero_grad(set_to_none=True)
        losses.total.backward()
        longest = settings.clip_norm or float("inf")
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), longest)
        self.optimizer.step()
        if self.average is not None:
            self._update(self.average, step)
        return {"loss": losses.total.detach(), **losses.terms, "gradient": norm.detach()}

    def autocast(self) -> torch.autocast:
        """The precision of forward passes."""
        precision = self._settings.precision
        is_half = precision == "bf16" or (precision == "auto" and self.device.type == "cuda")
        return torch.autocast(self.device.type, torch.bfloat16, enabled=is_half)

    @property
    def result(self) -> PredictorModel:
        """The network that is validated and kept: the average where there is one."""
        return self.model if self.average is None else self.average

    @torch.no_grad()
    def _update(self, average: PredictorModel, step: int) -> None:
        decay = min(self._settings.ema_decay, (1 + step) / (10 + step))  # short at first
        for mean, new in zip(average.parameters(), self.model.parameters(), strict=True):
            mean.lerp_(new, 1 - decay)
        for mean, new in zip(average.buffers(), self.model.buffers(), strict=True):
            mean.copy_(new)


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
