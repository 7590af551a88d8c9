"""A step of training: losses, gradients, new weights; recorded and replayed on a CUDA device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor, nn
from torch.func import functional_call

from robo_manip_baselines.policy.cuda_graph import Replay
from robo_manip_baselines.policy.interface import Batch, PolicyModel
from robo_manip_baselines.training.device import StepTimer
from robo_manip_baselines.training.state import TrainerState


class LossModule(nn.Module):
    """A network whose call is its loss: the form that DDP and ``torch.compile`` take."""

    def __init__(self, model: PolicyModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        """Return the loss and its parts."""
        return self.model.loss(batch)


class TrainingStep:
    """Step of the optimiser on a batch.

    Recorded, a step is one phase to the timer, ``forward``, and under autocast it casts the
    network's ``product_parameters`` all at once.

    Args:
        compute_loss: of a batch, by name; ``loss`` is minimised. Where the step is recorded, a
            `LossModule`, perhaps compiled.
        state: network and optimiser.
        autocast: type of the products, None for fp32.
        clip_norm: largest norm of the gradient; 0 for no clipping.
        timer: marks the end of each phase.
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
        self._cast: CastParameters | None = None
        if is_recorded:
            self._replay = Replay(self._compute_recorded, self._device)
            self._cast = _cast_parameters(compute_loss, state.model, autocast)

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Change the weights; return the losses, and ``grad_norm`` where gradients are clipped.

        What a recorded step returns is overwritten by the next one.
        """
        if self._replay is None:
            return self._compute(batch, self._timer.mark)
        if self._batch is None:
            self._batch = map_batch(batch, torch.clone)
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
            losses = dict((self._cast or self._compute_loss)(batch))
        mark("forward")
        losses["loss"].backward()
        if self._cast:
            self._cast.copy_gradients()
        mark("backward")
        if self._clip_norm:
            trained = self._state.trained
            losses["grad_norm"] = nn.utils.clip_grad_norm_(trained, self._clip_norm)
        self._state.optimizer.step()
        self._state.optimizer.zero_grad(set_to_none=True)
        # Detached: what led to them would be kept until the next step.
        return {name: value.detach() for name, value in losses.items()}


def _cast_parameters(
    compute_loss: object, model: PolicyModel, dtype: torch.dtype | None
) -> CastParameters | None:
    """Return the loss with parameters that are cast together; None where there are none."""
    names = [f"model.{name}" for name in model.product_parameters()]
    if dtype is None or not names or not isinstance(compute_loss, nn.Module):
        return None
    # Compiled, its parameters have other names, and casting is part of its kernels.
    known = dict(compute_loss.named_parameters())
    return CastParameters(compute_loss, names, dtype) if names[0] in known else None


class CastParameters:
    """Module that computes with copies of parameters in a smaller type.

    Autocast casts each where it is needed, and each gradient back: hundreds of kernels that do next
    to nothing. Here few do all of it, to the same numbers.

    Args:
        module: that computes from a batch.
        names: of its parameters that are cast.
        dtype: of the copies.
    """

    def __init__(self, module: nn.Module, names: Sequence[str], dtype: torch.dtype) -> None:
        self._module = module
        parameters = dict(module.named_parameters())
        self._parameters: list[Tensor] = [parameters[name] for name in names]
        self._gradients = [torch.zeros_like(p) for p in self._parameters]
        copies = [p.detach().to(dtype).requires_grad_(p.requires_grad) for p in self._parameters]
        self._copies = dict(zip(names, copies, strict=True))

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Return what the module returns for its parameters of this moment."""
        with torch.no_grad():
            _foreach_copy(list(self._copies.values()), self._parameters)
        return functional_call(self._module, self._copies, (batch,))

    @torch.no_grad()
    def copy_gradients(self) -> None:
        """Give each parameter the gradient of its copy."""
        found = [copy.grad for copy in self._copies.values()]
        pairs = zip(self._parameters, self._gradients, found, strict=True)
        known = [(p, own, gradient) for p, own, gradient in pairs if gradient is not None]
        _foreach_copy([own for _, own, _ in known], [gradient for _, _, gradient in known])
        for parameter, own, _ in known:
            parameter.grad = own
        for copy in self._copies.values():
            copy.grad = None


def _foreach_copy(targets: list[Tensor], sources: list[Tensor]) -> None:
    torch._foreach_copy_(targets, sources)  # pyright: ignore[reportPrivateImportUsage]


def map_batch(batch: Batch, change: Callable[[Tensor], Tensor]) -> Batch:
    """Return the batch with every tensor changed."""
    values = {field.name: getattr(batch, field.name) for field in fields(batch)}
    return replace(batch, **{k: None if v is None else change(v) for k, v in values.items()})
