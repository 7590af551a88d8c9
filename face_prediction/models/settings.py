"""Settings of the networks and of their training, presets, and the registry of networks.

PyTorch is not imported here: options and ``--help`` need settings only.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from annotated_types import Interval, Len

from robo_manip_baselines.runs.documents import as_json, convert
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import require_ranges

if TYPE_CHECKING:
    from typing_extensions import Self

    from face_prediction.models.interface import PredictorModel

Decay = Literal["constant", "cosine"]
Precision = Literal["auto", "fp32", "bf16"]

Channels = Annotated[tuple[Annotated[int, Interval(ge=1, le=2048)], ...], Len(1, 8)]
"""Channels of convolutions, one after another."""

ImageSize = Literal[32, 64, 128, 256]
"""Sides of images that a network can see: 256, and the fractions that JPEG decodes directly."""


@dataclass(frozen=True)
class _CheckedSettings:
    """Settings whose fields declare their ranges.

    Attributes:
        given: format of a name and a value in error messages.

    Raises:
        RequestError: a value is not valid.
    """

    given: ClassVar[str]

    def __post_init__(self) -> None:
        require_ranges(self, self.given)


@dataclass(frozen=True)
class PredictorTrainSettings(_CheckedSettings):
    """Everything that the weights depend on, beside network, data and seed.

    The defaults are the preset ``paper``: Adam at 1e-4 (paper, IV.B); how long, and on how many
    sequences at once, the paper does not say. Fields are the options of `FaceTrainOptions`.
    """

    given: ClassVar[str] = "--{} {}"

    steps: Annotated[int, Interval(ge=1, le=10**9)] = 20_000
    batch_size: Annotated[int, Interval(ge=1, le=65536)] = 16
    learning_rate: Annotated[float, Interval(ge=0.0, le=10.0)] = 1e-4
    schedule: Decay = "constant"
    warmup_steps: Annotated[int, Interval(ge=0, le=10**9)] = 0
    clip_norm: Annotated[float, Interval(ge=0.0, le=1e9)] = 1.0
    ema_decay: Annotated[float, Interval(ge=0.0, le=0.999999)] = 0.0
    augment: bool = False
    precision: Precision = "auto"
    validate_every: Annotated[int, Interval(ge=1, le=10**9)] = 500
    validation_sequences: Annotated[int, Interval(ge=0, le=10**9)] = 96

    def learning_rate_at(self, step: int) -> float:
        """Learning rate of the optimizer step that follows ``step`` others."""
        rate = self.learning_rate * min((step + 1) / (self.warmup_steps + 1), 1.0)
        if self.schedule == "cosine":
            done = max(step - self.warmup_steps, 0) / max(self.steps - self.warmup_steps, 1)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))
        return rate


@dataclass(frozen=True)
class ModelSettings(_CheckedSettings):
    """Base of every network's settings. The defaults are the preset ``paper``.

    Every field of a subclass has a default: a number, a bool, a text or a tuple of integers.
    Values that are read back must be of the same type. ``cpu`` holds what differs in that preset.
    """

    given: ClassVar[str] = "setting {}={}"
    cpu: ClassVar[Mapping[str, Any]] = {}

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as `from_json` takes them."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """Undo `to_json`.

        Raises:
            RequestError: keys are missing or unknown, or a value is not valid.
        """
        return convert(data, cls, "settings", complete=True)

    def changed(self, values: Mapping[str, Any]) -> Self:
        """Return a copy with other values, by name.

        Raises:
            RequestError: a name is unknown, or a value is not valid.
        """
        return convert(as_json(asdict(self) | dict(values)), type(self), "settings")

    def _require_halvings(self, side: int, channels: tuple[int, ...], least: int) -> None:
        """Check the ``channels`` of convolutions that each halve an image of ``side`` pixels."""
        if not channels or min(channels) < 1 or side >> len(channels) < least:
            raise RequestError(
                f"setting channels={channels}: not possible; valid: 1 or more channels for each of "
                f"1 or more halvings of {side} pixels, which leave {least} or more"
            )


@dataclass(frozen=True)
class ApproachSettings(ModelSettings):
    """Settings that the paper's three approaches share; `ImageOnlyModel` needs no others.

    The paper (IV.A) gives the sizes of images, history and horizon and the four layers. Widths,
    heads, the depth of the convolutions and dropout are ours.

    Attributes:
        size: side of the images in pixels, seen and predicted.
        channels: of the convolutions, each of which halves the image; the decoder has the same in
            reverse.
        width: of the tokens of the Transformer encoder, with ``heads`` and ``layers``.
        feedforward: hidden width of its feed-forward networks.
        dropout: in the Transformer encoder.
        history: frames seen.
        horizon: frames predicted.
    """

    cpu: ClassVar[Mapping[str, Any]] = {
        "size": 64,
        "channels": (8, 16, 32, 64),
        "width": 128,
        "heads": 4,
    } | {"feedforward": 256, "dropout": 0.0}

    size: ImageSize = 256
    channels: Channels = (32, 64, 128, 256, 256, 256)
    width: Annotated[int, Interval(ge=2, le=2048)] = 512
    heads: Annotated[int, Interval(ge=1, le=128)] = 8
    layers: Annotated[int, Interval(ge=1, le=16)] = 4
    feedforward: Annotated[int, Interval(ge=1, le=8192)] = 2048
    dropout: Annotated[float, Interval(ge=0.0, le=0.9)] = 0.1
    history: Annotated[int, Interval(ge=1, le=10_000)] = 70
    horizon: Annotated[int, Interval(ge=1, le=1000)] = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % (2 * self.heads):
            valid = f"valid: a multiple of 2 x heads={self.heads}"
            raise RequestError(f"setting width={self.width}: not divisible; {valid}")
        self._require_halvings(self.size, self.channels, least=2)


@dataclass(frozen=True)
class FusionSettings(ApproachSettings):
    """Settings of simple fusion, which sees and predicts landmarks, too.

    Attributes:
        landmark_width: of the landmark features (D_l of the paper).
        landmark_weight: of the landmarks' error in the loss, beside the images' (equation 5).
    """

    cpu: ClassVar[Mapping[str, Any]] = {**ApproachSettings.cpu, "landmark_width": 64}

    landmark_width: Annotated[int, Interval(ge=2, le=2048)] = 256
    landmark_weight: Annotated[float, Interval(ge=0.0, le=1e6)] = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.landmark_width % 2:
            raise RequestError(f"setting landmark_width={self.landmark_width}: odd; valid: even")


@dataclass(frozen=True)
class CrossAttentionSettings(FusionSettings):
    """Settings of cross-attention.

    Attributes:
        attention_width: of queries, keys and values (d of equation 1).
        residual: add the projected landmarks to what the attention gives, as Transformers do around
            every attention. Equations 1 to 3 do not.
    """

    cpu: ClassVar[Mapping[str, Any]] = {**FusionSettings.cpu, "attention_width": 128}

    attention_width: Annotated[int, Interval(ge=1, le=2048)] = 256
    residual: bool = False

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """Undo `to_json`; networks of releases without ``residual`` have none."""
        return super().from_json({"residual": False} | data if isinstance(data, dict) else data)


MODELS: dict[str, tuple[type[ModelSettings], str]] = {
    "image_only": (ApproachSettings, "approaches:ImageOnlyModel"),
    "simple_fusion": (FusionSettings, "approaches:SimpleFusionModel"),
    "cross_attention": (CrossAttentionSettings, "approaches:CrossAttentionModel"),
}
"""Settings of every network, and the module and class that are loaded when it is made."""

PRESETS = ("paper", "cpu")

# The cpu preset has minutes: it needs larger steps, and a schedule that ends them.
_CPU_TRAINING = PredictorTrainSettings(
    steps=1600,
    batch_size=4,
    learning_rate=1e-3,
    schedule="cosine",
    warmup_steps=100,
    augment=True,
    validate_every=400,
)


def settings_class(model: str) -> type[ModelSettings]:
    """Return the class of a network's settings.

    Raises:
        RequestError: the network is unknown.
    """
    if model not in MODELS:
        raise RequestError(f"model '{model}': unknown; valid: {', '.join(MODELS)}")
    return MODELS[model][0]


def make_predictor_model(model: str, settings: ModelSettings) -> PredictorModel:
    """Make a network, with weights drawn from torch's generator.

    Raises:
        RequestError: the network is unknown.
    """
    settings_class(model)
    module, _, kind = MODELS[model][1].partition(":")
    return getattr(importlib.import_module(f"face_prediction.models.{module}"), kind)(settings)


def preset_settings(model: str, preset: str) -> tuple[ModelSettings, PredictorTrainSettings]:
    """Return the settings of a network and of its training.

    Raises:
        RequestError: the network or the preset is unknown.
    """
    settings = settings_class(model)
    if preset not in PRESETS:
        raise RequestError(f"--preset {preset}: unknown; valid: {', '.join(PRESETS)}")
    if preset == "paper":
        return settings(), PredictorTrainSettings()
    return settings(**settings.cpu), _CPU_TRAINING
