"""Interface between a policy's network, its training and its evaluation.

Legend: B batch, O observation steps, S elements of all observed vectors together, N cameras, H and
W image height and width, K actions of a chunk, A elements of an action, Z elements of noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.presets import PolicyDims

__all__ = ["Batch", "PolicyDims", "PolicyModel", "masked_mean"]


@dataclass(frozen=True)
class Batch:
    """Examples of one training step, on the device of the network.

    Attributes:
        state: (B, O, S) float32, normalised; the last of the O steps is the present one, and steps
            before the start of the episode repeat its first.
        images: (B, O, N, H, W, 3) uint8 of the same steps, or None without cameras.
        action: (B, K, A) float32, normalised; anything where ``is_pad``.
        is_pad: (B, K) bool, True for steps after the end of the episode.
        noise: (B, Z) float32, standard normal, Z being the network's ``noise_size``.
        num_valid: () float32, steps of the whole batch that are not padding, divided by the number
            of processes that share the batch: a process that divides its sum by this number gets
            gradients whose average over the processes is the gradient of the whole batch's mean.
        num_examples: () float32, examples of the whole batch divided by the number of processes,
            to be used likewise for averages over examples.
        weight: (B, K) float32, factor of each action's error, with a mean of 1 over the steps of
            the whole batch that are not padding; None for 1 everywhere.
    """

    state: Tensor
    images: Tensor | None
    action: Tensor
    is_pad: Tensor
    noise: Tensor
    num_valid: Tensor
    num_examples: Tensor
    weight: Tensor | None = None

    def weighted(self, error: Tensor) -> Tensor:
        """Return the errors (B, K, A) of actions, times the weights of their steps."""
        return error if self.weight is None else error * self.weight[..., None]


class PolicyModel(nn.Module):
    """A network that predicts a chunk of actions from a window of observations.

    All randomness but dropout is drawn outside (``Batch.noise``, the noise of `predict`), so that
    ``loss`` and ``predict`` are functions of their arguments and of the parameters.

    Attributes:
        chunk_size: K, actions that `predict` returns.
        n_obs_steps: O, steps of the window, the present one included.
        noise_size: Z, elements of noise that `loss` needs for each example.
        sample_noise_size: Z, elements of noise that `predict` needs for each example.
        action_range: largest absolute normalised action that `predict` returns; None for no limit.
        strategies: of ``rtc``, which needs `inpaint`, and ``rtc_trained``, which needs `extend`,
            those with which the network can act.
        max_delay: largest delay that training with fixed actions has prepared the network for.
    """

    chunk_size: int
    n_obs_steps: int = 1
    noise_size: int = 0
    sample_noise_size: int = 0
    action_range: float | None = None
    strategies: tuple[str, ...] = ()
    max_delay: int = 0

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss``, the scalar to minimise, and its parts by name, all float32 scalars."""
        raise NotImplementedError

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) float32.

        Args:
            state: (B, O, S) float32, normalised.
            images: (B, O, N, H, W, 3) uint8; None without cameras.
            noise: (B, Z) float32, standard normal; None where ``sample_noise_size`` is 0. A row is
                a function of the episode's seed and of the control step, so that sampled actions
                do not depend on the number of environments.
        """
        raise NotImplementedError

    def inpaint(
        self,
        state: Tensor,
        images: Tensor | None,
        noise: Tensor | None,
        action: Tensor,
        weight: Tensor,
    ) -> Tensor:
        """Return a chunk (B, K, A) as `predict` does, drawn towards the one under way.

        ``action`` (B, K, A) float32, normalised, is what the chunk under way has for these steps;
        ``weight`` (B, K) float32 is 1 where that is executed in any case, 0 where the new chunk is
        free, and in between.
        """
        raise NotImplementedError

    def extend(
        self,
        state: Tensor,
        images: Tensor | None,
        noise: Tensor | None,
        action: Tensor,
        weight: Tensor,
    ) -> Tensor:
        """Return a chunk (B, K, A) that has the actions of weight 1, other than in `inpaint`."""
        raise NotImplementedError

    def product_parameters(self) -> Iterator[str]:
        """Yield the names of parameters that are read by products alone, which autocast casts."""
        yield from ()

    def for_inference(self, dtype: torch.dtype) -> PolicyModel:
        """Return a network that only predicts; this one, unless a policy knows a faster form.

        Args:
            dtype: of the matrix products, ``torch.float32`` or ``torch.bfloat16``; a policy that
                overrides this is run without autocast.
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
