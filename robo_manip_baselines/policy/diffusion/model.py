"""Diffusion Policy: noise is taken off a chunk of actions level by level (Chi et al. 2023).

Legend: B batch, K actions of a chunk, A elements of an action, T noise levels of the training.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.policy.denoising.network import (
    DenoisingModel,
    filled,
    guidance,
    mean_error,
)
from robo_manip_baselines.policy.diffusion.config import DiffusionConfig
from robo_manip_baselines.policy.interface import Batch, PolicyDims

LARGEST_BETA = 0.999
"""Most noise that one level adds (Nichol & Dhariwal 2021, section 3.2)."""


def squared_cosine(levels: int) -> NDArray[np.float64]:
    """Return (T,) the share of the actions' variance at each level, from little noise to much.

    The squared-cosine schedule (Nichol & Dhariwal 2021, eq. 17, with s = 0.008).
    """
    share = np.arange(levels + 1, dtype=np.float64) / levels
    cosine = np.cos((share + 0.008) / 1.008 * np.pi / 2) ** 2
    beta = np.minimum(1.0 - cosine[1:] / cosine[:-1], LARGEST_BETA)
    return np.cumprod(1.0 - beta, dtype=np.float64)


class DiffusionModel(DenoisingModel):
    """Diffusion Policy: the network learns the noise; DDIM or DDPM takes it off.

    At level k a chunk is sqrt(a_k) action + sqrt(1 - a_k) noise, ``a`` being `squared_cosine`.
    """

    signal: Tensor

    def __init__(self, config: DiffusionConfig, dims: PolicyDims) -> None:
        super().__init__(config, dims)
        self.config = config
        self.shares = squared_cosine(config.diffusion_steps)
        self.register_buffer("signal", torch.from_numpy(self.shares).float(), persistent=False)
        size = config.chunk_size * dims.action
        self.noise_size = size + 1  # and one for the level
        self.sample_noise_size = size * (1 + (config.sampling_steps - 1) * (config.eta > 0.0))
        self.action_range = config.clip_sample or None

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return the mean error of noise or action as ``loss``."""
        action, levels = filled(batch), self.config.diffusion_steps
        noise = batch.noise[:, :-1].view_as(action)
        level = (torch.special.ndtr(batch.noise[:, -1]) * levels).long().clamp(max=levels - 1)
        signal = self.signal[level][:, None, None]
        noisy = signal.sqrt() * action + (1.0 - signal).sqrt() * noise
        observed = self.observe(batch.state, batch.images)
        found = self.found(observed, noisy, level / levels)
        wanted = action if self.finds_action else noise
        return {"loss": mean_error(found, wanted, batch, self.error)}

    def sample(
        self,
        observed: Tensor,
        noise: Tensor | None,
        action: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Tensor:
        """Return a chunk (B, K, A) from noise (B, Z), guided as in Song et al. 2023."""
        assert noise is not None
        fresh = iter(noise.view(len(observed), -1, self.chunk_size, self.action_size).unbind(1))
        noisy, clip = next(fresh), self.config.clip_sample or math.inf
        for level, signal, signal_after in self._levels():
            root, spread = math.sqrt(signal), math.sqrt(1.0 - signal)
            time = torch.full_like(noisy[:, 0, 0], level / self.config.diffusion_steps)

            def clean(
                there: Tensor, time: Tensor = time, root: float = root, spread: float = spread
            ) -> Tensor:
                found = self.found(observed, there, time)
                return found if self.finds_action else (there - spread * found) / root

            if action is None or weight is None:
                estimate = clean(noisy)
            else:
                pull, estimate = guidance(clean, noisy, action, weight)
                estimate = estimate + min(self.max_guidance, 1.0 / root) * pull
            estimate = estimate.clamp(-clip, clip)
            found = (noisy - root * estimate) / spread
            # Song et al. 2021 ("DDIM"), eq. 12 and 16.
            change = self.config.eta * math.sqrt(
                (1.0 - signal_after) / (1.0 - signal) * (1.0 - signal / signal_after)
            )
            left = math.sqrt(max(1.0 - signal_after - change**2, 0.0))
            noisy = math.sqrt(signal_after) * estimate + left * found
            if change:
                noisy = noisy + change * next(fresh)
        return noisy

    def _levels(self) -> Iterator[tuple[int, float, float]]:
        """Yield the levels that sampling visits, with ``a`` there and after it, down to 1."""
        steps = np.linspace(len(self.shares) - 1, 0, self.config.sampling_steps)
        visited = steps.round().astype(int).tolist()
        shares = self.shares.tolist()
        for level, after in zip(visited, [*visited[1:], None], strict=True):
            yield level, shares[level], 1.0 if after is None else shares[after]
