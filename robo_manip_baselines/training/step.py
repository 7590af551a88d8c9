"""AdamW, its learning rate as a function of the step, and the moving average of the weights."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from robo_manip_baselines.policy.interface import Batch, PolicyModel
from robo_manip_baselines.policy.presets import TrainSettings
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training.device import Processes
from robo_manip_baselines.training.timing import PhaseClock


class RunningMean:
    """Means of scalars that stay on the device until they are asked for.

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
        """Take in the scalars of a step."""
        values = torch.stack([value.double() for value in metrics.values()])
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
        """Start anew."""
        self.sums, self.count = None, 0


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
    """Return what a step (from 0 on) multiplies the learning rate by.

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
    """Give every group its own learning rate times ``factor``."""
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
        self._averages: list[torch.Tensor] = list(self.model.parameters())
        self._weights: list[torch.Tensor] = list(model.parameters())
        self._source: nn.Module = model

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Take in the weights after a step; no host synchronisation."""
        decay = min(self._decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
            self._averages, self._weights, 1.0 - decay
        )

    @torch.no_grad()
    def copy_buffers(self) -> None:
        """Take over what is no weight, such as running statistics."""
        for mine, theirs in zip(self.model.buffers(), self._source.buffers(), strict=True):
            mine.copy_(theirs)


class LossOf(nn.Module):
    """A network whose call is its loss: the form that DDP and ``torch.compile`` take."""

    def __init__(self, model: PolicyModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss and its parts."""
        return self.model.loss(batch)


class TrainStep:
    """Carries out steps on a network, which it changes.

    Args:
        model: on its device already.
        settings: optimiser, precision, ...
        total_steps: for the schedule of the learning rate.
        seed: of the run; dropout is drawn from it and the step.
        autocast: type of autocast, or None.
        processes: that share each batch.
        clock: where the phases are timed; one of its own if not given.

    Attributes:
        model: the network.
        average: the moving average of its weights, or None.
        optimizer: AdamW.
        autocast: as given.
        clock: of the phases.
    """

    def __init__(
        self,
        model: PolicyModel,
        settings: TrainSettings,
        *,
        total_steps: int,
        seed: int,
        autocast: torch.dtype | None,
        processes: Processes | None = None,
        clock: PhaseClock | None = None,
    ) -> None:
        processes = processes or Processes()
        self.model = model
        self.device = next(model.parameters()).device
        # Only convolutions have weights of four dimensions: in the layout of the images they read.
        self.model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.optimizer = make_optimizer(model, settings)
        self.average = WeightAverage(model, settings.ema_decay) if settings.ema_decay else None
        self.clock = clock or PhaseClock(self.device)
        self._trained = [p for group in self.optimizer.param_groups for p in group["params"]]
        self._settings = settings
        self._total_steps = total_steps
        self._seed = seed
        self._rank = processes.rank
        self.autocast = autocast
        loss: nn.Module = LossOf(model)
        if processes.world_size > 1:
            loss = DistributedDataParallel(loss, gradient_as_bucket_view=True)
        self._loss = torch.compile(loss) if settings.compile else loss

    def __call__(self, batch: Batch, step: int) -> dict[str, Tensor]:
        """Train on a batch; return the parts of the loss and the gradient's norm on the device."""
        self.clock.mark("data")
        settings = self._settings
        if not self.model.training:
            self.model.train()
        torch.manual_seed(derive_seed(self._seed, "dropout", self._rank, step))
        factor = learning_rate_factor(step, self._total_steps, settings)
        set_learning_rate(self.optimizer, factor)
        with torch.autocast(self.device.type, self.autocast, enabled=self.autocast is not None):
            parts = self._loss(batch)
        self.clock.mark("forward")
        parts["loss"].backward()
        self.clock.mark("backward")
        metrics = {name: value.detach() for name, value in parts.items()}
        if settings.clip_norm:
            norm = nn.utils.clip_grad_norm_(self._trained, settings.clip_norm)
            metrics["grad_norm"] = norm.detach()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        if self.average:
            self.average.update(step)
        self.clock.mark("optimizer")
        return metrics

    @property
    def result(self) -> PolicyModel:
        """The network that is validated and saved: the average where there is one."""
        if self.average is None:
            return self.model
        self.average.copy_buffers()
        return self.average.model
