"""One step of training: forward, backward, optimiser. No host synchronisation."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from robo_manip_baselines.policy.interface import Batch, PolicyModel
from robo_manip_baselines.training.distributed import Processes
from robo_manip_baselines.training.optimizer import (
    WeightAverage,
    learning_rate_factor,
    make_optimizer,
    set_learning_rate,
)
from robo_manip_baselines.training.phases import PhaseClock
from robo_manip_baselines.training.seeds import derive_seed
from robo_manip_baselines.training.settings import TrainSettings


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
