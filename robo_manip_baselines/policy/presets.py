"""Settings that every policy has in common: dimensions, training, action execution, presets.

Nothing heavy is imported here, so that ``--help`` needs no PyTorch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from annotated_types import Interval

from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.observation.spec import ImageSize
from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.ranges import Amount, Count, Fraction, NonNegativeInt, require_ranges

SAMPLERS = ("episode", "frame")
PRECISIONS = ("auto", "fp32", "bf16")
SCHEDULES = ("constant", "cosine")

AUGMENTATIONS = ("none", "shift", "shift+colour")
"""Random changes to the images of training batches."""

STRATEGIES = ("synchronous", "naive", "ensemble", "rtc", "rtc_trained", "roll_forward")
"""Names of the ways to execute chunks; all but ``ensemble`` execute one chunk at a time."""

MAX_VECTOR = 4096
"""Most elements of a state or an action."""

MAX_CAMERAS = 64

MAX_CHUNK = 10_000
"""Most actions that are predicted at once."""

Chunk = Annotated[int, Interval(ge=1, le=MAX_CHUNK)]
Delay = Annotated[int, Interval(ge=0, le=MAX_CHUNK)]
InferenceDelay = Delay | Literal["measured"]
"""Control steps, or as many as a prediction takes on this machine."""
Width = Annotated[int, Interval(ge=1, le=65536)]
Layers = Annotated[int, Interval(ge=1, le=256)]


@dataclass(frozen=True)
class PolicyDims:
    """Dimensions of a policy's inputs and outputs.

    Attributes:
        state: S, elements of all observed vectors together.
        action: A, elements of an action.
        cameras: N, perhaps 0.
        image: (H, W) in pixels.
    """

    state: Annotated[int, Interval(ge=1, le=MAX_VECTOR)]
    action: Annotated[int, Interval(ge=1, le=MAX_VECTOR)]
    cameras: Annotated[int, Interval(ge=0, le=MAX_CAMERAS)]
    image: ImageSize

    def __post_init__(self) -> None:
        require_ranges(self)


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
        epochs: budget in epochs; None where ``steps`` gives it.
        steps: budget in optimiser steps; None where ``epochs`` gives it.
        state_noise: standard deviation of the Gaussian noise that is added, in training, to the
            proprioceptive part of the state (joints, gripper), in units of each element's own; 0
            for none. Scripted demonstrations never leave their path: without noise a policy learns
            to read the next target off the last one, and fails where no demonstration has been.
        clock_noise: likewise for the time since the start that ``current_pred`` observes, the same
            for all its frames. A policy that can read the clock releases by the clock, whether or
            not it has reached the target.
        object_noise: standard deviation, m, of the Gaussian noise that is added, in training, to
            the observed positions of objects that are carried; 0 for none. An object that is held
            is where the gripper is: without, a policy reads off it what ``state_noise`` hides.
        action_noise: standard deviation of the Gaussian noise that is added, in training, to the
            actions, in units of each element's own (RoboManipBaselines: ``--action_aug_std``).
        intervention_weight: factor of the error of actions that a person chose instead of the
            policy (`intervention` of the episodes), before weights are scaled to a mean of 1 over a
            batch; 1 weights all actions the same. Held-out losses are not weighted.
        augment: random changes to the images in training: ``shift``, ``shift+colour`` (also
            contrast, brightness and tint) or ``none``.
        augment_shift: largest shift as a proportion of the images' sides (robomimic crops 76 of 84
            pixels: ±4.8 %).
        validation_fraction: proportion of the episodes that is held out (public ACT: 0.2).
        ema_decay: decay of the moving average of the weights that is evaluated and saved; 0 for
            none.
        norm: normalisation of states and actions, ``mean_std``, ``min_max`` (to [-1, 1]),
            ``action_min_max`` (that of actions, the other of states) or ``none``; the policy's own
            if not given.
        relative_actions: whether joint targets are predicted relative to the observed posture; the
            gripper's stay as they are.
        skip: control steps between two actions of a chunk, and between two observations of a
            window (RoboManipBaselines: ``--skip``); between two actions, targets are interpolated.
        early_stopping: validations without a smaller loss on the episodes held out after which the
            training ends; 0 for none. The checkpoint of the smallest loss is kept in ``best``.
        precision: ``fp32``, ``bf16`` (autocast; losses and norms stay fp32), or ``auto``.
        compile: whether to use ``torch.compile``.
        cuda_graph: whether a single process on a CUDA device records its step once and replays it,
            which saves the launches of a thousand kernels; elsewhere it has no effect.

    Raises:
        RequestError: a value that is not valid.
    """

    batch_size: Annotated[int, Interval(ge=1, le=65536)] = 8
    learning_rate: Annotated[float, Interval(gt=0.0, le=100.0)] = 1e-5
    weight_decay: Amount = 1e-4
    schedule: str = "constant"
    warmup_steps: NonNegativeInt = 0
    clip_norm: Amount = 0.0
    sampler: str = "episode"
    epochs: Count | None = None
    steps: Count | None = None
    state_noise: Amount = 0.0
    clock_noise: Amount = 0.0
    object_noise: Amount = 0.0
    action_noise: Amount = 0.0
    intervention_weight: Annotated[float, Interval(gt=0.0, le=1e6)] = 1.0
    augment: str = "none"
    augment_shift: Fraction = 0.04
    validation_fraction: Fraction = 0.2
    ema_decay: Fraction = 0.0
    norm: str | None = None
    relative_actions: bool = False
    skip: Annotated[int, Interval(ge=1, le=1000)] = 1
    early_stopping: NonNegativeInt = 0
    precision: str = "auto"
    compile: bool = False
    cuda_graph: bool = True

    def __post_init__(self) -> None:
        require_choice("sampler", self.sampler, SAMPLERS)
        require_choice("precision", self.precision, PRECISIONS)
        require_choice("schedule", self.schedule, SCHEDULES)
        require_choice("augment", self.augment, AUGMENTATIONS)
        if (self.epochs is None) == (self.steps is None):
            raise RequestError("give the budget as --epochs or as --steps, one of the two")
        require_ranges(self)
        if self.early_stopping and not self.validation_fraction:
            raise RequestError(
                f"early_stopping {self.early_stopping}: no episodes are held out to stop by; give "
                "a --validation_fraction, for example 0.1"
            )


@dataclass(frozen=True)
class ActionExecution:
    """Execution of predicted action chunks.

    With a delay, a chunk can be executed so many control steps after the observation that it was
    made from. What happens meanwhile is the strategy; ``docs/policies.md`` describes them.

    Attributes:
        temporal_ensemble: predict a chunk at every step and average all predictions for that step;
            otherwise execute the beginning of a chunk before the next is predicted.
        ensemble_decay: k in the weights exp(-k i) of the ensemble, i = 0 for the oldest prediction
            (public ACT: 0.01).
        n_action_steps: actions of a chunk that are executed, without the ensemble.
        strategy: without the ensemble, any other of ``STRATEGIES``.
        inference_delay: control steps between an observation and the first action that is made
            from it.

    Raises:
        RequestError: a value that is not valid.
    """

    temporal_ensemble: bool = True
    ensemble_decay: Annotated[float, Interval(ge=-100.0, le=100.0)] = 0.01
    n_action_steps: Chunk = 1
    strategy: str = "synchronous"
    inference_delay: Delay = 0

    def __post_init__(self) -> None:
        require_ranges(self)
        require_choice("strategy", self.strategy, [s for s in STRATEGIES if s != "ensemble"])

    @property
    def name(self) -> str:
        """Strategy, which is ``ensemble`` with the temporal ensemble."""
        return "ensemble" if self.temporal_ensemble else self.strategy

    def to_json(self) -> dict[str, Any]:
        """Return all settings under the names that checkpoints have had since the first release.

        Strategy and delay, which are younger, are left out where they make no difference.
        """
        values = {
            "temporal_ensemble": self.temporal_ensemble,
            "decay": self.ensemble_decay,
            "execute": self.n_action_steps,
        }
        if self.name not in ("ensemble", "synchronous"):
            values["strategy"] = self.strategy
        return values | ({"delay": self.inference_delay} if self.inference_delay else {})

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ActionExecution:
        """Undo `to_json`.

        Raises:
            RequestError: a name or a value is not valid.
        """
        names = {
            "decay": "ensemble_decay",
            "execute": "n_action_steps",
            "delay": "inference_delay",
        }
        return convert({names.get(k, k): v for k, v in values.items()}, cls, "acting")


@dataclass(frozen=True)
class PolicyPreset:
    """A named set of defaults for training a policy; each can be overridden.

    Attributes:
        config: the policy's own frozen dataclass.
        training: optimiser, sampling and budget.
        execution: execution of the predicted action chunks.
        cameras, image_size, object_pose: observed beside the robot and the target.
    """

    config: Any
    training: TrainSettings
    execution: ActionExecution
    cameras: tuple[str, ...] = CAMERAS
    image_size: tuple[int, int] = (480, 640)
    object_pose: bool = False


STATE_ONLY_TRAINING = TrainSettings(
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
"""Training of policies without images, minutes on two cores; ``docs/act.md`` has the ablations."""

IMAGE_TRAINING = replace(STATE_ONLY_TRAINING, augment="shift", augment_shift=0.02)
"""The same with images, on a processor without a GPU: a few pixels of shift, with which a small
network found mouths more exactly in demonstrations that it had not seen."""
