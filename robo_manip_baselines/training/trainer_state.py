"""What training needs beside the evaluated weights to go on exactly: flat tensors and JSON.

Tensors are named ``weights/NAME`` (only where an average is what is evaluated),
``exp_avg/NAME`` and ``exp_avg_sq/NAME`` (AdamW), and ``metrics`` (sums since the last line of
``metrics.jsonl``); NAME is the parameter's name in the network.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from robo_manip_baselines.training.metrics import RunningMean
from robo_manip_baselines.training.step import TrainStep

_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Progress:
    """How far a run has come.

    Attributes:
        step: optimiser steps done.
        seconds: spent on them, by all processes that took part in turn.
    """

    step: int = 0
    seconds: float = 0.0


def trainer_state(
    train_step: TrainStep, mean: RunningMean, progress: Progress
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return what `restore` takes."""
    tensors: dict[str, Tensor] = {}
    if train_step.average:
        tensors |= {f"weights/{k}": v for k, v in train_step.model.state_dict().items()}
    steps: dict[str, int] = {}
    for name, parameter in _trained(train_step):
        if state := train_step.optimizer.state.get(parameter):
            tensors |= {f"{moment}/{name}": state[moment] for moment in _MOMENTS}
            steps[name] = int(state["step"])
    if mean.sums is not None:
        tensors["metrics"] = mean.sums
    # Every trained parameter has made as many steps as the others, unless some get no gradient.
    json = {
        "step": progress.step,
        "seconds": progress.seconds,
        "optimizer_steps": steps,
        "metrics": {"names": list(mean.names), "count": mean.count},
    }
    return tensors, json


@torch.no_grad()
def restore(
    train_step: TrainStep,
    mean: RunningMean,
    model_state: Mapping[str, Tensor],
    tensors: Mapping[str, Tensor],
    json: Mapping[str, Any],
) -> Progress:
    """Put a fresh `TrainStep` where another one was.

    Args:
        train_step: of the same network and settings; changed.
        mean: changed.
        model_state: the checkpoint's evaluated weights.
        tensors: as `trainer_state` gave them.
        json: the same.
    """
    online = model_state
    if train_step.average:
        train_step.average.model.load_state_dict(model_state)
        online = {
            name.removeprefix("weights/"): tensor
            for name, tensor in tensors.items()
            if name.startswith("weights/")
        }
    train_step.model.load_state_dict(online)
    fused = bool(train_step.optimizer.defaults["fused"])
    for name, parameter in _trained(train_step):
        if name not in json["optimizer_steps"]:
            continue
        device = parameter.device if fused else "cpu"
        # In the memory layout of the parameter, as AdamW itself makes them.
        moments = {m: torch.empty_like(parameter).copy_(tensors[f"{m}/{name}"]) for m in _MOMENTS}
        count = torch.tensor(float(json["optimizer_steps"][name]), device=device)
        train_step.optimizer.state[parameter] = {"step": count, **moments}
    mean.names = tuple(json["metrics"]["names"])
    mean.count = json["metrics"]["count"]
    mean.sums = tensors["metrics"].to(train_step.device) if mean.count else None
    return Progress(json["step"], json["seconds"])


def _trained(train_step: TrainStep) -> Iterator[tuple[str, torch.nn.Parameter]]:
    grouped = {id(p) for group in train_step.optimizer.param_groups for p in group["params"]}
    for name, parameter in train_step.model.named_parameters():
        if id(parameter) in grouped:
            yield name, parameter
