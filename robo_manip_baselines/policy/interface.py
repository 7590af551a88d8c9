"""What every policy's network is to training and to evaluation.

Legend: B batch, S elements of all observed vectors together, N cameras, H and W image height and
width, K actions of a chunk, A elements of an action, Z numbers of noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.presets import Sizes

__all__ = ["Batch", "PolicyModel", "Sizes", "masked_mean"]


@dataclass(frozen=True)
class Batch:
    """What one training step sees, on the device of the network.

    Attributes:
        state: (B, S) float32, normalised.
        images: (B, N, H, W, 3) uint8 as they are in the files, or None without cameras.
        action: (B, K, A) float32, normalised; anything where ``is_pad``.
        is_pad: (B, K) bool, True for steps after the end of the episode.
        noise: (B, Z) float32, standard normal, Z as the network's ``noise_size`` asks.
        num_valid: () float32, steps of the whole batch that are not padding, divided by the number
            of processes that share the batch: a process that divides its sum by this number gets
            gradients whose average over the processes is the gradient of the whole batch's mean.
        num_examples: () float32, examples of the whole batch divided by the number of processes,
            to be used likewise by what is averaged over examples.
    """

    state: Tensor
    images: Tensor | None
    action: Tensor
    is_pad: Tensor
    noise: Tensor
    num_valid: Tensor
    num_examples: Tensor


class PolicyModel(nn.Module):
    """A network that predicts a chunk of actions.

    Training draws all randomness but dropout for it (``Batch.noise``), so that ``loss`` is a
    function of the batch and of the parameters.
    """

    chunk_size: int
    """K, actions that ``predict`` returns."""

    noise_size: int = 0
    """Z, numbers of noise that ``loss`` needs for each example."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss``, the scalar to minimise, and its parts by name, all float32 scalars."""
        raise NotImplementedError

    def predict(self, state: Tensor, images: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) float32 for states (B, S), images (B, N, H, W, 3)."""
        raise NotImplementedError

    def for_inference(self, dtype: torch.dtype) -> PolicyModel:
        """Return a network that only predicts; this one, unless a policy knows a faster form.

        Args:
            dtype: of the matrix products, ``torch.float32`` or ``torch.bfloat16``; who overrides
                this needs no autocast.
        """
        return self

    def parameter_groups(self, learning_rate: float) -> list[dict[str, object]]:
        """Return the optimiser's parameter groups; one for all unless a policy overrides it."""
        trained = [parameter for parameter in self.parameters() if parameter.requires_grad]
        return [{"params": trained, "lr": learning_rate}]


def masked_mean(error: Tensor, is_pad: Tensor, num_valid: Tensor) -> Tensor:
    """Average (B, K, A) errors over valid steps: padding is in neither sum nor count."""
    kept = torch.where(is_pad[..., None], 0.0, error)
    return kept.sum() / (num_valid * error.shape[-1])
