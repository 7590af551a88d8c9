"""Settings and presets that Diffusion and Flow share. Importing this needs no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

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
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Fraction, require_ranges

RESNET18_PARAMETERS = 11_200_000

GROUPS = 8
"""Groups of each group normalisation (public Diffusion Policy: 8)."""

Loss = Literal["l2", "l1"]
"""Mean squared error, mean absolute error."""


@dataclass(frozen=True)
class DenoisingConfig:
    """Network from noisy actions, their noise level and observations to a direction.

    Attributes:
        chunk_size: K, actions predicted at once (Chi et al.: 16, at 10 Hz); with the backbone
            unet a multiple of 2 for each of its levels but the last.
        backbone: unet, convolutions over the steps of the chunk (Chi et al.); transformer, tokens
            for the steps that attend to the observation (Chi et al.); or perceptron, over the whole
            chunk, on a processor in a fourth of their time.
        target: of the network: noise, as published (with Flow the velocity, action less noise), or
            action, from which the noise follows. Actions fill few of the dimensions that noise
            fills: a small network learns them sooner.
        loss: of the target: l2, the mean squared error, as published, with which a policy learns
            the distribution; or l1, the mean absolute error, with which it learns medians: a
            gripper that is to open at one of several steps is open or closed, and never half open.
        n_obs_steps: O, observation steps, the present one last (Chi et al.: 2).
        channels: of the levels of the U-Net, each but the last halving the steps (Chi et al.
            without images: 256, 512, 1024).
        kernel_size: steps that a convolution of the U-Net sees, odd (Chi et al.: 5).
        hidden_size: width of the Transformer, a fourth of the perceptron's, and size of the
            embedded observation and of the embedded noise level (Chi et al.: 256).
        num_layers: decoder layers of the Transformer (Chi et al.: 8), or residual blocks of the
            perceptron.
        num_heads: attention heads of the Transformer (Chi et al.: 4).
        dropout: of the Transformer (public Diffusion Policy: 0.3, of attention weights alone).
        vision: encoder of the images, one for all cameras: resnet18, or small, four convolutions.
        keypoints: points in each image whose coordinates describe it: the spatial softmax of Chi
            et al. (32).
        max_guidance: largest weight of the guidance with --strategy rtc (Black et al. 2025, arXiv
            2506.07339: 5).
        sampling_noise: standard deviation of the noise that predictions begin with, and of any that
            is added on the way; in training it is 1. With 1 a prediction is drawn from the learned
            distribution. With 0 the same is predicted each time, which is steadier where the
            demonstrations have one way to do it (Pan et al. 2025, arXiv 2512.01809, begin with 0,
            too).

    Raises:
        RequestError: a value that is not valid.
    """

    chunk_size: Chunk = 16
    backbone: Literal["unet", "transformer", "perceptron"] = "unet"
    target: Literal["noise", "action"] = "noise"
    loss: Loss = "l2"
    n_obs_steps: Annotated[int, Interval(ge=1, le=64)] = 2
    channels: tuple[Width, ...] = (256, 512, 1024)
    kernel_size: Annotated[int, Interval(ge=1, le=63)] = 5
    hidden_size: Width = 256
    num_layers: Layers = 8
    num_heads: Annotated[int, Interval(ge=1, le=1024)] = 4
    dropout: Fraction = 0.0
    vision: Literal["resnet18", "small"] = "resnet18"
    keypoints: Annotated[int, Interval(ge=1, le=4096)] = 32
    max_guidance: Annotated[float, Interval(ge=0.0, le=1e6)] = 5.0
    sampling_noise: Annotated[float, Interval(ge=0.0, le=10.0)] = 1.0

    def __post_init__(self) -> None:
        require_ranges(self)
        if not self.channels:
            raise RequestError("channels: must name at least one level, as in --channels 64 128")
        for width in self.channels:
            _require_multiple("channels", width, GROUPS, f"{GROUPS}, the groups of a normalisation")
        if not self.kernel_size % 2:
            raise RequestError(f"kernel_size {self.kernel_size}: must be odd")
        heads = f"twice num_heads {self.num_heads}"
        _require_multiple("hidden_size", self.hidden_size, 2 * self.num_heads, heads)
        if self.backbone == "unet":
            levels = len(self.channels)
            why = f"{2 ** (levels - 1)}, which the {levels} levels of the U-Net divide it by"
            _require_multiple("chunk_size", self.chunk_size, 2 ** (levels - 1), why)

    def num_parameters(self, dims: PolicyDims) -> int:
        """Return about how many weights the network has: its matrices and convolutions."""
        width, kernel = self.hidden_size, self.kernel_size
        features = dims.state + dims.cameras * 2 * self.keypoints
        count = width * (self.n_obs_steps * features + 9 * width)
        if dims.cameras and self.vision == "resnet18":
            count += RESNET18_PARAMETERS
        if self.backbone == "transformer":
            return count + self.num_layers * 16 * width**2
        if self.backbone == "perceptron":
            chunk = 2 * 4 * width * self.chunk_size * dims.action
            return count + chunk + (8 + self.num_layers * (2 * 16 + 2 * 2 * 4)) * width**2
        for below, channels in zip((0, *self.channels), self.channels, strict=False):
            down = channels * (below + 3 * channels)
            up = below * (2 * channels + 3 * below)
            count += kernel * (down + up) + 7 * below**2 + 8 * width * (channels + below)
        return count + 4 * kernel * self.channels[-1] ** 2 + 8 * width * self.channels[-1]


def _require_multiple(name: str, value: int, divisor: int, why: str) -> None:
    if value % divisor:
        raise RequestError(f"{name} {value}: must be a multiple of {why}")


_SMALL: dict[str, Any] = {
    "chunk_size": 32,
    "channels": (48, 96),
    "hidden_size": 128,
    "num_layers": 3,
    "vision": "small",
    "target": "action",
}
"""Sizes in the presets for a processor without a GPU."""

_ONE_WAY: dict[str, Any] = {"loss": "l1", "sampling_noise": 0.0}
"""For demonstrations of a scripted expert, which has one way to do it; docs/policies.md has the
success without."""

_PAPER_TRAINING = TrainSettings(
    batch_size=16,
    learning_rate=1e-4,
    weight_decay=1e-6,
    schedule="cosine",
    warmup_steps=500,
    sampler="frame",
    epochs=300,
    validation_fraction=0.0,
    ema_decay=0.9999,
)
"""Training of the public Diffusion Policy with images of real robots, its configuration
``train_diffusion_unet_real_image_workspace``; but for AdamW's first beta, 0.95 there."""

Config = TypeVar("Config", bound=DenoisingConfig)


def denoising_presets(
    kind: type[Config], *, paper: dict[str, Any] | None = None, cpu: dict[str, Any] | None = None
) -> dict[str, PolicyPreset]:
    """Return the presets of a policy whose settings are of this kind.

    ``paper`` and ``cpu`` are settings of these presets that only this policy has.
    """
    execution = ActionExecution(temporal_ensemble=False, n_action_steps=8)
    return {
        "paper": PolicyPreset(
            config=kind(chunk_size=64, channels=(512, 1024, 2048), **(paper or {})),
            training=_PAPER_TRAINING,
            execution=ActionExecution(temporal_ensemble=False, n_action_steps=16),
            image_size=(96, 128),
        ),
        "cpu": PolicyPreset(
            config=kind(**_SMALL, **_ONE_WAY, backbone="perceptron", n_obs_steps=1, **(cpu or {})),
            training=STATE_ONLY_TRAINING,
            execution=execution,
            cameras=(),
            object_pose=True,
        ),
        "cpu_images": PolicyPreset(
            config=kind(**_SMALL),
            training=IMAGE_TRAINING,
            execution=execution,
            cameras=("angle", "front_close"),
            image_size=(60, 80),
        ),
    }
