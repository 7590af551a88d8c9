"""Settings and presets of the recurrent policy. Importing this needs no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from annotated_types import Interval

from robo_manip_baselines.policy.presets import (
    IMAGE_TRAINING,
    STATE_ONLY_TRAINING,
    ActionExecution,
    Chunk,
    Layers,
    PolicyDims,
    PolicyPreset,
    TrainSettings,
    Width,
)
from robo_manip_baselines.runs.ranges import Amount, require_ranges

VISION_PARAMETERS = {"small": 60_000, "resnet18": 11_200_000}
"""Weights of each encoder of images."""


@dataclass(frozen=True)
class SarnnConfig:
    """Recurrent network with spatial attention (after Ichiwara et al. 2022, "SARNN").

    Attributes:
        chunk_size: K, actions predicted at once (Ichiwara et al.: 1).
        n_obs_steps: O, observations that the network remembers, the present one last; each is
            ``skip`` control steps after the one before.
        hidden_size: width of the recurrent layers (public code, EIPL: 50).
        num_layers: recurrent layers (EIPL: 1).
        prediction_weight: weight, in the loss, of the squared error of the next observation, which
            the network predicts at every step that it remembers; 0 predicts none.
        vision: encoder of the images, one for all cameras: resnet18, or small, four convolutions.
        keypoints: points in each image whose coordinates describe it, the spatial attention
            (EIPL: 5).

    Raises:
        RequestError: a value that is not valid.
    """

    chunk_size: Chunk = 1
    n_obs_steps: Annotated[int, Interval(ge=1, le=1024)] = 32
    hidden_size: Width = 128
    num_layers: Layers = 1
    prediction_weight: Amount = 0.1
    vision: Literal["resnet18", "small"] = "small"
    keypoints: Annotated[int, Interval(ge=1, le=4096)] = 8

    def __post_init__(self) -> None:
        require_ranges(self)

    def num_parameters(self, dims: PolicyDims) -> int:
        """Return about how many weights the network has: its matrices and convolutions."""
        width, features = self.hidden_size, dims.state + 2 * self.keypoints * dims.cameras
        count = features * width + 8 * self.num_layers * width**2
        count += VISION_PARAMETERS[self.vision] * (dims.cameras > 0)
        return count + width * (self.chunk_size * dims.action + features + width)


PRESETS = {
    "paper": PolicyPreset(
        config=SarnnConfig(n_obs_steps=64, hidden_size=50, keypoints=5),
        training=TrainSettings(
            *(5, 1e-3),
            sampler="frame",
            steps=20_000,
            validation_fraction=0.0,
            norm="min_max",
            skip=6,
        ),
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=6),
        image_size=(96, 128),
    ),
    "cpu": PolicyPreset(
        config=SarnnConfig(chunk_size=30, n_obs_steps=8, hidden_size=192),
        training=STATE_ONLY_TRAINING,
        execution=ActionExecution(),
        cameras=(),
        object_pose=True,
    ),
    "cpu_images": PolicyPreset(
        config=SarnnConfig(chunk_size=30, n_obs_steps=4),
        training=replace(IMAGE_TRAINING, batch_size=16),
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=8),
        cameras=("angle", "front_close"),
        image_size=(60, 80),
    ),
}
