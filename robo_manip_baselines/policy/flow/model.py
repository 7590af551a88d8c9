"""Flow matching: a velocity that carries noise to a chunk of actions along straight lines.

Legend: B batch, K actions of a chunk, A elements of an action.
"""

from __future__ import annotations

import torch
from torch import Tensor

from robo_manip_baselines.policy.denoising.network import (
    DenoisingModel,
    filled,
    guidance,
    mean_error,
)
from robo_manip_baselines.policy.flow.config import FlowConfig
from robo_manip_baselines.policy.interface import Batch, PolicyDims


class FlowModel(DenoisingModel):
    """Rectified flow (Liu et al. 2023): at time t, 0 to 1, an action is (1 - t) noise + t action.

    The network learns the velocity, action - noise; Euler steps follow it from noise.
    """

    def __init__(self, config: FlowConfig, dims: PolicyDims) -> None:
        super().__init__(config, dims, marks_prefix=config.max_prefix > 0)
        self.sampling_steps, self.max_prefix = config.sampling_steps, config.max_prefix
        size = config.chunk_size * dims.action
        self.sample_noise_size = size
        self.noise_size = size + 1 + self.marks_prefix  # the time, and the length of the prefix
        if self.marks_prefix:
            self.strategies = ("rtc", "rtc_trained")
        self.max_delay = config.max_prefix

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean error of velocity or action as ``loss``."""
        action, size = filled(batch), self.sample_noise_size
        noise = batch.noise[:, :size].view_as(action)
        time = torch.special.ndtr(batch.noise[:, size])  # uniform from 0 to 1
        position = torch.lerp(noise, action, time[:, None, None])
        observed = self.observe(batch.state, batch.images)
        wanted = action if self.finds_action else action - noise
        if not self.marks_prefix:
            found = self.found(observed, position, time)
            return {"loss": mean_error(found, wanted, batch, self.error)}
        # Each length from 0 to max_prefix is as likely; fixed steps are no error.
        length = torch.special.ndtr(batch.noise[:, size + 1]) * (self.max_prefix + 1)
        steps = torch.arange(self.chunk_size, device=action.device)
        is_fixed = steps < length.floor().clamp(max=self.max_prefix)[:, None]
        position = torch.where(is_fixed[..., None], action, position)
        found = self.found(observed, position, time, is_fixed)
        found = torch.where(is_fixed[..., None], wanted, found)
        return {"loss": mean_error(found, wanted, batch, self.error)}

    def sample(
        self,
        observed: Tensor,
        noise: Tensor | None,
        action: Tensor | None = None,
        weight: Tensor | None = None,
        fixed: Tensor | None = None,
    ) -> Tensor:
        """Return a chunk (B, K, A), carried from noise by Euler steps.

        Guided as in Black et al. 2025 (2506.07339); ``fixed`` (B, K) steps stay ``action``.
        """
        assert noise is not None
        position = noise.view(len(observed), self.chunk_size, -1)
        for step in range(self.sampling_steps):
            time = step / self.sampling_steps
            position = _kept(position, action, fixed)
            if action is None or weight is None:
                velocity = self._velocity(observed, position, time, fixed)
            else:
                velocity = self._guided_velocity(observed, position, time, action, weight)
            position = position + velocity / self.sampling_steps
        return _kept(position, action, fixed)

    def extend(
        self,
        state: Tensor,
        images: Tensor | None,
        noise: Tensor | None,
        action: Tensor,
        weight: Tensor,
    ) -> Tensor:
        """Return a chunk whose steps of weight 1 are those of ``action``, as in training."""
        observed, fixed = self.observe(state, images), weight >= 1.0
        return self.sample(observed, self.scaled(noise), action, fixed=fixed)

    def _guided_velocity(
        self, observed: Tensor, position: Tensor, time: float, action: Tensor, weight: Tensor
    ) -> Tensor:
        left = 1.0 - time

        def ahead(there: Tensor) -> Tensor:
            return there + left * self._velocity(observed, there, time, None)

        pull, estimate = guidance(ahead, position, action, weight)
        # Eq. 2 and 4 there: r² = (1 - t)² / (t² + (1 - t)²), weight (1 - t) / (t r²).
        strength = self.max_guidance
        if time > 0.0:
            strength = min(strength, (time**2 + left**2) / (time * left))
        return (estimate - position) / left + strength * pull

    def _velocity(
        self, observed: Tensor, position: Tensor, time: float, is_fixed: Tensor | None
    ) -> Tensor:
        if self.marks_prefix and is_fixed is None:
            is_fixed = torch.zeros_like(position[..., 0], dtype=torch.bool)
        found = self.found(observed, position, torch.full_like(position[:, 0, 0], time), is_fixed)
        return (found - position) / (1.0 - time) if self.finds_action else found


def _kept(position: Tensor, action: Tensor | None, fixed: Tensor | None) -> Tensor:
    """Return (B, K, A) with ``action`` in the steps that are fixed, (B, K)."""
    if action is None or fixed is None:
        return position
    return torch.where(fixed[..., None], action, position)
