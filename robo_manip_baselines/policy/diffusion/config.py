"""Settings and presets of Diffusion Policy. Importing this needs no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from robo_manip_baselines.policy.denoising.config import DenoisingConfig, denoising_presets
from robo_manip_baselines.policy.presets import PolicyPreset
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

    Raises:
        RequestError: a value that is not valid.
    """

    diffusion_steps: Annotated[int, Interval(ge=2, le=10_000)] = 100
    sampling_steps: Annotated[int, Interval(ge=1, le=10_000)] = 10
    eta: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    clip_sample: Amount = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sampling_steps > self.diffusion_steps:
            raise RequestError(
                f"sampling_steps {self.sampling_steps}: must be 1 to diffusion_steps "
                f"{self.diffusion_steps}"
            )


PRESETS: dict[str, PolicyPreset] = denoising_presets(DiffusionConfig)
