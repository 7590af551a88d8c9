"""What a preset of a policy decides: the network, its training, what it is shown, how it acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.training.settings import TrainSettings


@dataclass(frozen=True)
class Acting:
    """How chunks of actions become actions.

    Attributes:
        temporal_ensemble: ask the network at every step and average all its predictions for that
            step; otherwise carry out the beginning of a chunk before the next is asked for.
        decay: k in the weights exp(-k i) of the ensemble, i = 0 for the oldest prediction (public
            ACT: 0.01).
        execute: actions of a chunk that are carried out, without the ensemble.

    Raises:
        RequestError: a value that is not valid.
    """

    temporal_ensemble: bool = True
    decay: float = 0.01
    execute: int = 1

    def __post_init__(self) -> None:
        if self.execute < 1:
            raise RequestError(f"execute {self.execute}: must be 1 or more actions")


@dataclass(frozen=True)
class PolicyPreset:
    """One named set of choices; whoever trains may override each of them.

    Attributes:
        config: the policy's own frozen dataclass.
        training: optimiser, sampling and budget.
        cameras, image_size, object_pose: what is shown beside the robot and the mouth.
        acting: how chunks become actions.
    """

    config: Any
    training: TrainSettings
    acting: Acting
    cameras: tuple[str, ...] = CAMERAS
    image_size: tuple[int, int] = (480, 640)
    object_pose: bool = False


WITHOUT_IMAGES = TrainSettings(
    batch_size=64,
    learning_rate=1e-3,
    schedule="cosine",
    warmup_steps=100,
    sampler="frame",
    steps=6000,
    state_noise=0.2,
    clock_noise=0.5,
    validation_fraction=0.0,
    ema_decay=0.999,
)
"""How policies are trained that see no images, in minutes on two cores; ``docs/act.md`` says what
was tried."""
