"""Settings and presets of the flow-matching policy. Importing this needs no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from robo_manip_baselines.policy.denoising.config import DenoisingConfig, denoising_presets
from robo_manip_baselines.policy.presets import PolicyPreset
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class FlowConfig(DenoisingConfig):
    """Flow matching along straight lines from noise to actions (Lipman et al. 2023).

    Attributes:
        sampling_steps: Euler steps from noise to actions.
        max_prefix: training fixes the first 0 to so many actions of a chunk, so that the policy can
            act with --strategy rtc_trained and delays up to it (Black et al. 2025, arXiv
            2512.05964); 0 for none.

    Raises:
        RequestError: a value that is not valid.
    """

    sampling_steps: Annotated[int, Interval(ge=1, le=1000)] = 5
    max_prefix: Annotated[int, Interval(ge=0, le=10_000)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_prefix >= self.chunk_size:
            raise RequestError(
                f"max_prefix {self.max_prefix}: must be less than chunk_size {self.chunk_size}"
            )


PRESETS: dict[str, PolicyPreset] = denoising_presets(
    FlowConfig, paper={"sampling_steps": 10}, cpu={"sampling_steps": 2}
)
