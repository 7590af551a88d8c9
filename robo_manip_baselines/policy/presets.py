"""What a network must fit. Nothing heavy is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.runs.errors import RequestError, require_choice


@dataclass(frozen=True)
class Sizes:
    """What a network must fit.

    Attributes:
        state: S, elements of all observed vectors together.
        action: A, elements of an action.
        cameras: N, perhaps 0.
        image: (H, W) in pixels.
    """

    state: int
    action: int
    cameras: int
    image: tuple[int, int]


SAMPLERS = ("episode", "frame")
PRECISIONS = ("auto", "fp32", "bf16")
SCHEDULES = ("constant", "cosine")


@dataclass(frozen=True)
class TrainSettings:
    """Optimiser, sampling and budget.

    Attributes:
        batch_size: examples a step, all processes together (paper, Table III: 8).
        learning_rate: of AdamW (paper, Table III: 1e-5).
        weight_decay: of AdamW (public ACT: 1e-4).
        schedule: of the learning rate after the warm-up: ``constant``, or ``cosine`` down to zero.
        warmup_steps: steps over which the learning rate rises linearly.
        clip_norm: largest norm of the gradient; 0 for no clipping.
        sampler: ``episode``: an epoch draws one start from each episode (paper); ``frame``: an
            epoch visits every frame once.
        epochs: budget in epochs; None where ``steps`` says it.
        steps: budget in optimiser steps; None where ``epochs`` says it.
        state_noise: standard deviation of the Gaussian noise that is added, in training, to what
            the robot feels of itself (joints, gripper), in units of each element's own; 0 for
            none. Scripted demonstrations never leave their path: without noise a policy learns to
            read the next target off the last one, and is lost where no demonstration has been.
        clock_noise: likewise for the time since the start that ``current_pred`` shows, the same
            for all its frames. With a clock to go by, a policy lets go by the clock, whether or
            not it has reached the mouth.
        validation_fraction: share of the episodes that is held out (public ACT: 0.2).
        ema_decay: decay of the moving average of the weights that is evaluated and saved; 0 for
            none.
        precision: ``fp32``, ``bf16`` (autocast; losses and norms stay fp32), or ``auto``.
        compile: whether to use ``torch.compile``.

    Raises:
        RequestError: a value that is not valid.
    """

    batch_size: int = 8
    learning_rate: float = 1e-5
    weight_decay: float = 1e-4
    schedule: str = "constant"
    warmup_steps: int = 0
    clip_norm: float = 0.0
    sampler: str = "episode"
    epochs: int | None = None
    steps: int | None = None
    state_noise: float = 0.0
    clock_noise: float = 0.0
    validation_fraction: float = 0.2
    ema_decay: float = 0.0
    precision: str = "auto"
    compile: bool = False

    def __post_init__(self) -> None:
        require_choice("sampler", self.sampler, SAMPLERS)
        require_choice("precision", self.precision, PRECISIONS)
        require_choice("schedule", self.schedule, SCHEDULES)
        if (self.epochs is None) == (self.steps is None):
            raise RequestError("give the budget as --epochs or as --steps, one of the two")
        for name in ("batch_size", "epochs", "steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise RequestError(f"{name} {value}: must be 1 or more")
        if not self.learning_rate > 0.0:
            raise RequestError(f"learning_rate {self.learning_rate}: must be more than 0")
        for name in ("weight_decay", "warmup_steps", "clip_norm", "state_noise", "clock_noise"):
            if getattr(self, name) < 0:
                raise RequestError(f"{name} {getattr(self, name)}: must be 0 or more")
        for name in ("validation_fraction", "ema_decay"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise RequestError(f"{name} {getattr(self, name)}: must be 0 or more, less than 1")


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
