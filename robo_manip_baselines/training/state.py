"""State of a trainer: network, optimiser and moving average.

It is saved and restored exactly, so that resuming changes nothing.

Beside the evaluated weights a checkpoint has tensors named ``weights/NAME`` (the trained weights,
only where an average is evaluated), ``exp_avg/NAME`` and ``exp_avg_sq/NAME`` (AdamW), and
``metrics`` (sums since the last line of ``metrics.jsonl``); NAME is the parameter's name.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.checkpoint import (
    TRAINER_TENSORS,
    Checkpoint,
    read_trainer,
    read_weights,
)
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import TrainSettings
from robo_manip_baselines.runs.tensors import require_alike, require_finite

_MOMENTS = ("exp_avg", "exp_avg_sq")


def make_optimizer(model: PolicyModel, settings: TrainSettings) -> torch.optim.AdamW:
    """Make AdamW over the policy's parameter groups, fused where the device has it.

    On a CUDA device learning rates are tensors there, as a recorded step needs them.
    """
    device, rate = next(model.parameters()).device, settings.learning_rate
    groups: Any = model.parameter_groups(rate)
    optimizer = torch.optim.AdamW(
        groups,
        lr=rate,
        weight_decay=settings.weight_decay,
        fused=device.type in ("cpu", "cuda"),
        capturable=device.type == "cuda",
    )
    for group in optimizer.param_groups:
        group["initial_lr"] = group["lr"]
        if device.type == "cuda":
            group["lr"] = torch.tensor(group["lr"], device=device)
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
        rate = group["initial_lr"] * factor
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


class WeightAverage:
    """Exponential moving average of a network's weights.

    The decay of step n (from 0 on) is min(decay, (1 + n) / (10 + n)), as is usual, so that the
    random initial weights are soon forgotten; it depends on the step alone.

    Attributes:
        model: a copy of the network with the averaged weights.
    """

    def __init__(self, model: PolicyModel, decay: float) -> None:
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self._decay, self._source = decay, model
        averages: list[Tensor] = list(self.model.parameters())
        weights: list[Tensor] = list(model.parameters())
        self._pairs = averages, weights

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Include the weights after a step; no host synchronisation."""
        decay = min(self._decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(*self._pairs, 1.0 - decay)  # pyright: ignore[reportPrivateImportUsage]

    @torch.no_grad()
    def copy_buffers(self) -> None:
        """Copy buffers, such as running statistics, from the network."""
        for own, source in zip(self.model.buffers(), self._source.buffers(), strict=True):
            own.copy_(source)


class RunningMean:
    """Means of scalars that stay on the device until they are needed.

    Attributes:
        names: of the scalars; none before the first step.
        count: steps that are summed.
        sums: () or (n,) float64, on the device.
    """

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.count = 0
        self.sums: Tensor | None = None

    def add(self, metrics: Mapping[str, Tensor]) -> None:
        """Include the scalars of a step."""
        values = torch.stack([value.detach().double() for value in metrics.values()])
        if self.sums is None:
            self.names, self.sums = tuple(metrics), values
        else:
            self.sums += values
        self.count += 1

    def means(self) -> Tensor:
        """Return the means, (n,) float64, still on the device; nothing is reset."""
        assert self.sums is not None, "no step yet"
        return self.sums / self.count

    def reset(self) -> None:
        """Forget all steps."""
        self.sums, self.count = None, 0


class TrainerState:
    """Everything that a training step changes.

    Attributes:
        model: the trained network, on its device already when given.
        optimizer: AdamW.
        average: moving average of the weights, or None.
        losses: means since they were last written.
    """

    def __init__(self, model: PolicyModel, settings: TrainSettings) -> None:
        # Only convolutions have weights of four dimensions: in the layout of the images they read.
        model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.model = model
        self.optimizer = make_optimizer(model, settings)
        self.average = WeightAverage(model, settings.ema_decay) if settings.ema_decay else None
        self.losses = RunningMean()

    @property
    def trained(self) -> list[nn.Parameter]:
        """Parameters of the optimiser."""
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    @property
    def evaluated(self) -> PolicyModel:
        """The network that is validated and saved: the average where there is one."""
        if self.average is None:
            return self.model
        self.average.copy_buffers()
        return self.average.model

    def state_dict(self, step: int, seconds: float) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return what `restore` needs beside the evaluated weights, as tensors and as JSON.

        The optimiser has done ``step`` steps in so many seconds.
        """
        tensors: dict[str, Tensor] = {}
        if self.average:
            tensors |= {f"weights/{k}": v for k, v in self.model.state_dict().items()}
        steps: dict[str, int] = {}  # differ only where a parameter got no gradient
        for name, parameter in self._named():
            if state := self.optimizer.state.get(parameter):
                tensors |= {f"{moment}/{name}": state[moment] for moment in _MOMENTS}
                steps[name] = int(state["step"])
        if self.losses.sums is not None:
            tensors["metrics"] = self.losses.sums
        metrics = {"names": list(self.losses.names), "count": self.losses.count}
        json = {"step": step, "seconds": seconds, "optimizer_steps": steps, "metrics": metrics}
        return tensors, json

    @torch.no_grad()
    def restore(self, checkpoint: Checkpoint) -> float:
        """Restore a checkpoint of the same network and settings; return the seconds spent so far.

        Raises:
            RequestError: the checkpoint lacks the trainer's state, or it is damaged.
        """
        wanted = self.model.state_dict()
        weights = read_weights(checkpoint, wanted)
        tensors, numbers = read_trainer(checkpoint)
        source = checkpoint.folder / TRAINER_TENSORS
        expected = {f"weights/{name}": value for name, value in wanted.items() if self.average}
        expected |= {
            f"{moment}/{name}": parameter.detach()
            for name, parameter in self._named()
            for moment in _MOMENTS
            if name in numbers.optimizer_steps
        }
        state = {name: value for name, value in tensors.items() if name != "metrics"}
        require_alike(state, expected, source)
        require_finite(state, source)
        if self.average:
            self.average.model.load_state_dict(weights)
            prefix = "weights/"
            weights = {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}
        self.model.load_state_dict(weights)
        fused = bool(self.optimizer.defaults["fused"])
        for name, parameter in self._named():
            if name not in numbers.optimizer_steps:
                continue
            device = parameter.device if fused else "cpu"
            count = torch.tensor(float(numbers.optimizer_steps[name]), device=device)
            self.optimizer.state[parameter] = {"step": count}
            for moment in _MOMENTS:  # in the memory layout of the parameter, as AdamW makes them
                value = torch.empty_like(parameter).copy_(tensors[f"{moment}/{name}"])
                self.optimizer.state[parameter][moment] = value
        self.losses.names = tuple(numbers.metrics["names"])
        self.losses.count = numbers.metrics["count"]
        if self.losses.count:
            self.losses.sums = tensors["metrics"].to(next(self.model.parameters()).device)
        return numbers.seconds

    def _named(self) -> Iterator[tuple[str, nn.Parameter]]:
        trained = set(map(id, self.trained))
        return ((n, p) for n, p in self.model.named_parameters() if id(p) in trained)
