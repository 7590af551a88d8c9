"""Settings and presets of the flow-matching policy. Importing this needs no PyTorch."""

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


@dataclass(frozen=True)
class FlowConfig(DenoisingConfig):
    """Flow matching along straight lines from noise to actions (Lipman et al. 2023).

    Attributes:
        sampling_steps: Euler steps from noise to actions.
        max_prefix: training fixes the first 0 to so many actions of a chunk, so that the policy can
            act with --strategy rtc_trained and delays up to it (Black et al. 2025, arXiv
            2512.05964); 0 for none.
        max_guidance: largest weight of the guidance with --strategy rtc (Black et al. 2025, arXiv
            2506.07339: 5).

    Raises:
        RequestError: a value that is not valid.
    """

    sampling_steps: Annotated[int, Interval(ge=1, le=1000)] = 5
    max_prefix: Annotated[int, Interval(ge=0, le=10_000)] = 0
    max_guidance: Annotated[float, Interval(ge=0.0, le=1e6)] = 5.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_prefix >= self.chunk_size:
            raise RequestError(
                f"max_prefix {self.max_prefix}: must be less than chunk_size {self.chunk_size}"
            )


_EXECUTION = ActionExecution(temporal_ensemble=False, n_action_steps=8)

PRESETS = {
    "paper": PolicyPreset(
        config=FlowConfig(chunk_size=64, channels=(512, 1024, 2048), sampling_steps=10),
        training=PAPER_TRAINING,
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=16),
        image_size=(96, 128),
    ),
    "cpu": PolicyPreset(
        config=FlowConfig(**SMALL, backbone="perceptron", sampling_steps=2),
        training=STATE_ONLY_TRAINING,
        execution=_EXECUTION,
        cameras=(),
        object_pose=True,
    ),
    "cpu_images": PolicyPreset(
        config=FlowConfig(**SMALL),
        training=STATE_ONLY_TRAINING,
        execution=_EXECUTION,
        cameras=("angle", "front_close"),
        image_size=(60, 80),
    ),
}
