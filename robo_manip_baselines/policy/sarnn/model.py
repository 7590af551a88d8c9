"""Recurrent policy: what it remembers is a function of the observations of its window.

Its hidden state begins with zeros at the first observation of the window and is not kept between
predictions. So the state of an episode, of each of many environments and of a training example are
the same by construction, and nothing has to be reset.

Legend: B batch, O observation steps, S elements of the state, N cameras, H and W image height and
width, F features of an observation, D hidden size, K actions of a chunk, A elements of an action.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.denoising.network import ImageEncoder
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel, masked_mean
from robo_manip_baselines.policy.sarnn.config import SarnnConfig


class SarnnModel(PolicyModel):
    """LSTM over state and keypoints, with heads for actions and for the next observation.

    After Ichiwara et al. 2022 (SARNN): the network also predicts what it will observe. There it
    draws the next image from predicted keypoints; here the keypoints and the state are the target.
    """

    def __init__(self, config: SarnnConfig, dims: PolicyDims) -> None:
        super().__init__()
        self.chunk_size, self.n_obs_steps = config.chunk_size, config.n_obs_steps
        self.prediction_weight = config.prediction_weight
        width = config.hidden_size
        self.vision = ImageEncoder(config.vision, config.keypoints) if dims.cameras else None
        features = dims.state + 2 * config.keypoints * dims.cameras
        self.encoder = nn.Sequential(nn.Linear(features, width), nn.LayerNorm(width), nn.GELU())
        self.memory = nn.LSTM(width, width, config.num_layers, batch_first=True)
        self.actions = nn.Sequential(
            nn.Linear(width, width), nn.GELU(), nn.Linear(width, config.chunk_size * dims.action)
        )
        self.next = nn.Linear(width, features) if config.prediction_weight else None

    def features(self, state: Tensor, images: Tensor | None) -> Tensor:
        """Return (B, O, F): the state, and the keypoints of (B, O, N, H, W, 3)."""
        if self.vision is None:
            return state
        assert images is not None
        points = self.vision(images.flatten(0, 2)).view(*state.shape[:2], -1)
        return torch.cat([state, points], dim=-1)

    def chunk(self, hidden: Tensor) -> Tensor:
        """Return normalised actions (B, K, A) from the hidden state (B, D)."""
        return self.actions(hidden).float().unflatten(-1, (self.chunk_size, -1))

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A)."""
        hidden, _ = self.memory(self.encoder(self.features(state, images)))
        return self.chunk(hidden[:, -1])

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss``, the mean absolute error ``l1`` and the ``prediction``'s squared one."""
        features = self.features(batch.state, batch.images)
        hidden, _ = self.memory(self.encoder(features))
        error = nn.functional.l1_loss(self.chunk(hidden[:, -1]), batch.action, reduction="none")
        l1 = masked_mean(batch.weighted(error), batch.is_pad, batch.num_valid)
        if self.next is None:
            return {"loss": l1, "l1": l1}
        # Detached: the encoder is not to make its keypoints easy to predict.
        wrong = (self.next(hidden[:, :-1]) - features[:, 1:].detach()).square()
        size = max(wrong[0].numel(), 1)
        prediction = wrong.sum() / (batch.num_examples * size)
        return {
            "loss": l1 + self.prediction_weight * prediction,
            "l1": l1,
            "prediction": prediction,
        }
