"""A step of training: losses, gradients, new weights; recorded and replayed on a CUDA device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.cuda_graph import Replay
from robo_manip_baselines.policy.interface import Batch
from robo_manip_baselines.training.device import StepTimer
from robo_manip_baselines.training.state import TrainerState


class TrainingStep:
    """Step of the optimiser on a batch.

    Recorded, a step is one phase to the timer, ``forward``.

    Args:
        compute_loss: of a batch, by name; ``loss`` is minimised.
        state: network and optimiser.
        autocast: type of the products, None for fp32.
        clip_norm: largest norm of the gradient; 0 for no clipping.
        timer: told the end of each phase.
        is_recorded: replay the step from a CUDA graph.
    """

    def __init__(
        self,
        compute_loss: Callable[[Batch], Mapping[str, Tensor]],
        state: TrainerState,
        *,
        autocast: torch.dtype | None,
        clip_norm: float,
        timer: StepTimer,
        is_recorded: bool = False,
    ) -> None:
        self._compute_loss, self._state, self._timer = compute_loss, state, timer
        self._autocast, self._clip_norm = autocast, clip_norm
        self._device = next(state.model.parameters()).device
        self._batch: Batch | None = None
        self._replay: Replay[dict[str, Tensor]] | None = None
        if is_recorded:
            self._replay = Replay(self._compute_recorded, self._device)

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Change the weights; return the losses, and ``grad_norm`` where gradients are clipped.

        What a recorded step returns is overwritten by the next one.
        """
        if self._replay is None:
            return self._compute(batch, self._timer.mark)
        if self._batch is None:
            self._batch = _map(batch, torch.clone)
        else:
            for field in fields(Batch):
                if (value := getattr(batch, field.name)) is not None:
                    getattr(self._batch, field.name).copy_(value, non_blocking=True)
        losses = self._replay()
        self._timer.mark("forward")
        self._timer.mark("backward")
        return losses

    def _compute_recorded(self) -> dict[str, Tensor]:
        assert self._batch is not None
        return self._compute(self._batch, lambda phase: None)

    def _compute(self, batch: Batch, mark: Callable[[str], None]) -> dict[str, Tensor]:
        with torch.autocast(self._device.type, self._autocast, enabled=bool(self._autocast)):
            losses = dict(self._compute_loss(batch))
        mark("forward")
        losses["loss"].backward()
        mark("backward")
        if self._clip_norm:
            trained = self._state.trained
            losses["grad_norm"] = nn.utils.clip_grad_norm_(trained, self._clip_norm)
        self._state.optimizer.step()
        self._state.optimizer.zero_grad(set_to_none=True)
        # Detached: what led to them would be kept until the next step.
        return {name: value.detach() for name, value in losses.items()}


def _map(batch: Batch, change: Callable[[Tensor], Tensor]) -> Batch:
    values = {field.name: getattr(batch, field.name) for field in fields(batch)}
    return replace(batch, **{k: None if v is None else change(v) for k, v in values.items()})
