"""One step of training: forward, backward, Adam. No wait for the device."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from face_prediction.models.interface import PredictorModel
from face_prediction.training.augmentation import augment
from face_prediction.training.seeds import generator, torch_seed
from face_prediction.training.settings import TrainSettings
from face_prediction.training.windows import Batch


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
