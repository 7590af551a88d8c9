"""AdamW, its learning rate as a function of the step, and the moving average of the weights."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import TrainSettings


def make_optimizer(model: PolicyModel, settings: TrainSettings) -> torch.optim.AdamW:
    """Make AdamW over the policy's parameter groups, fused where the device has it."""
    fused = next(model.parameters()).device.type in ("cpu", "cuda")
    optimizer = torch.optim.AdamW(
        model.parameter_groups(settings.learning_rate),  # pyright: ignore[reportArgumentType]
        lr=settings.learning_rate,
        weight_decay=settings.weight_decay,
        fused=fused,
    )
    for group in optimizer.param_groups:
        group["initial_lr"] = group["lr"]
    return optimizer


def learning_rate_factor(step: int, total_steps: int, settings: TrainSettings) -> float:
    """Return the factor of the learning rate at a step, counted from 0.

    The warm-up rises linearly and reaches 1 at step ``warmup_steps``; ``cosine`` then falls from 1
    to 0, which it would reach one step after the last.
    """
    if step < settings.warmup_steps:
        return (step + 1) / (settings.warmup_steps + 1)
    if settings.schedule == "constant":
        return 1.0
    length = max(total_steps - settings.warmup_steps, 1)
    progress = min((step - settings.warmup_steps) / length, 1.0)
    return 0.5 * (1.0 + math.cos(math.pi * progress))


def set_learning_rate(optimizer: torch.optim.Optimizer, factor: float) -> None:
    """Set every group to its own initial learning rate times ``factor``."""
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * factor


class WeightAverage:
    """Exponential moving average of a network's weights.

    The decay of step n (from 0 on) is min(decay, (1 + n) / (10 + n)), as is usual, so that the
    random initial weights are soon forgotten; it depends on the step alone.

    Attributes:
        model: a copy of the network with the averaged weights.
    """

    def __init__(self, model: PolicyModel, decay: float) -> None:
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self._decay = decay
        self._averages: list[Tensor] = list(self.model.parameters())
        self._weights: list[Tensor] = list(model.parameters())
        self._source = model

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Include the weights after a step; no host synchronisation."""
        decay = min(self._decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
            self._averages, self._weights, 1.0 - decay
        )

    @torch.no_grad()
    def copy_buffers(self) -> None:
        """Copy buffers, such as running statistics, from the network."""
        for own, source in zip(self.model.buffers(), self._source.buffers(), strict=True):
            own.copy_(source)
