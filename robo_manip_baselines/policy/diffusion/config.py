"""Settings and presets of Diffusion Policy. Importing this needs no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from robo_manip_baselines.policy.denoising.config import (
    PAPER_TRAINING,
    SMALL,
    DenoisingConfig,
)
from robo_manip_baselines.policy.presets import (
    STATE_ONLY_TRAINING,
    ActionExecution,
    PolicyPreset,
)
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Amount


@dataclass(frozen=True)
class DiffusionConfig(DenoisingConfig):
    """Diffusion Policy (Chi et al. 2023, arXiv 2303.04137).

    Attributes:
        diffusion_steps: noise levels of the training (Chi et al.: 100).
        sampling_steps: noise levels that sampling visits (Chi et al.: 100, and 10 on robots).
        eta: noise that sampling adds, of that of the training's reverse process: 0 is DDIM (Song et
            al. 2021), 1 with all levels is DDPM (Ho et al. 2020).
        clip_sample: largest absolute normalised action of a prediction (Chi et al.: 1, the range of
            the demonstrations); 0 for none.
        max_guidance: largest weight of the guidance with --strategy rtc (Black et al. 2025, arXiv
            2506.07339: 5).

    Raises:
        RequestError: a value that is not valid.
    """

    diffusion_steps: Annotated[int, Interval(ge=2, le=10_000)] = 100
    sampling_steps: Annotated[int, Interval(ge=1, le=10_000)] = 10
    eta: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    clip_sample: Amount = 1.0
    max_guidance: Annotated[float, Interval(ge=0.0, le=1e6)] = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sampling_steps > self.diffusion_steps:
            raise RequestError(
                f"sampling_steps {self.sampling_steps}: must be 1 to diffusion_steps "
                f"{self.diffusion_steps}"
            )


_EXECUTION = ActionExecution(temporal_ensemble=False, n_action_steps=8)

PRESETS = {
    "paper": PolicyPreset(
        config=DiffusionConfig(chunk_size=64, channels=(512, 1024, 2048)),
        training=PAPER_TRAINING,
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=16),
        image_size=(96, 128),
    ),
    "cpu": PolicyPreset(
        config=DiffusionConfig(**SMALL, backbone="perceptron"),
        training=STATE_ONLY_TRAINING,
        execution=_EXECUTION,
        cameras=(),
        object_pose=True,
    ),
    "cpu_images": PolicyPreset(
        config=DiffusionConfig(**SMALL),
        training=STATE_ONLY_TRAINING,
        execution=_EXECUTION,
        cameras=("angle", "front_close"),
        image_size=(60, 80),
    ),
}
