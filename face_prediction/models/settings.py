"""Settings of the networks and of their training, presets, and the registry of networks.

PyTorch is not imported here: options and ``--help`` need settings only.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self

    from face_prediction.models.interface import PredictorModel

Decay = Literal["constant", "cosine"]
Precision = Literal["auto", "fp32", "bf16"]

IMAGE_SIZES = (32, 64, 128, 256)
"""Sides of images that a network can see: 256, and the fractions that JPEG decodes directly."""


def _within(default: Any, low: float, high: float) -> Any:
    """Declare a field for numbers from ``low`` to ``high``."""
    return field(default=default, metadata={"range": (low, high)})


@dataclass(frozen=True)
class _CheckedSettings:
    """Settings whose fields declare what is valid.

    Attributes:
        given: format of a name and a value in error messages.

    Raises:
        RequestError: a value is not valid.
    """

    given: ClassVar[str]

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            given = self.given.format(item.name, value)
            low, high = item.metadata.get("range", (-math.inf, math.inf))
            choices = item.metadata.get("choices", (value,))
            if value not in choices:
                raise RequestError(f"{given}: unknown; valid: {', '.join(map(str, choices))}")
            if isinstance(value, (int, float)) and not low <= value <= high:
                raise RequestError(f"{given}: out of range; valid: {low} to {high:g}")


@dataclass(frozen=True)
class PredictorTrainSettings(_CheckedSettings):
    """Everything that the weights depend on, beside network, data and seed.

    The defaults are the preset ``paper``: Adam at 1e-4 (paper, IV.B); how long, and on how many
    sequences at once, the paper does not say. Fields are the options of `FaceTrainOptions`.
    """

    given: ClassVar[str] = "--{} {}"

    steps: int = _within(20_000, 1, 1e9)
    batch_size: int = _within(16, 1, 65536)
    learning_rate: float = _within(1e-4, 0.0, 10.0)
    schedule: Decay = field(default="constant", metadata={"choices": get_args(Decay)})
    warmup_steps: int = _within(0, 0, 1e9)
    clip_norm: float = _within(1.0, 0.0, 1e9)
    ema_decay: float = _within(0.0, 0.0, 0.999999)
    augment: bool = False
    precision: Precision = field(default="auto", metadata={"choices": get_args(Precision)})
    validate_every: int = _within(500, 1, 1e9)
    validation_sequences: int = _within(96, 0, 1e9)

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
        names = {item.name for item in fields(cls)}
        if not isinstance(data, Mapping) or set(data) != names:
            raise RequestError(f"{cls.__name__} needs the keys {', '.join(sorted(names))}")
        return cls().changed(data)

    def changed(self, values: Mapping[str, Any]) -> Self:
        """Return a copy with other values, by name.

        Raises:
            RequestError: a name is unknown, or a value is not valid.
        """
        defaults = {item.name: getattr(self, item.name) for item in fields(self)}
        for name in values:
            if name not in defaults:
                raise RequestError(f"setting '{name}': unknown; valid: {', '.join(defaults)}")
        return replace(self, **{k: _like(k, v, defaults[k]) for k, v in values.items()})

    def _require_halvings(self, side: int, channels: tuple[int, ...], least: int) -> None:
        """Check the ``channels`` of convolutions that each halve an image of ``side`` pixels."""
        if not channels or min(channels) < 1 or side >> len(channels) < least:
            raise RequestError(
                f"setting channels={channels}: not possible; valid: 1 or more channels for each of "
                f"1 or more halvings of {side} pixels, which leave {least} or more"
            )


def _like(name: str, value: Any, default: Any) -> Any:
    """Convert ``value`` to the type of ``default``, where that changes nothing."""
    if isinstance(default, tuple):
        if isinstance(value, (list, tuple)) and all(type(item) is int for item in value):
            return tuple(value)
        raise RequestError(f"setting {name}={value}: wrong type; valid: a list of whole numbers")
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if type(value) is not type(default):
        kind = type(default).__name__
        raise RequestError(f"setting {name}={value}: wrong type; valid: {kind}, like {default}")
    return value


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

    size: int = field(default=256, metadata={"choices": IMAGE_SIZES})
    channels: tuple[int, ...] = (32, 64, 128, 256, 256, 256)
    width: int = _within(512, 2, 8192)
    heads: int = _within(8, 1, 128)
    layers: int = _within(4, 1, 64)
    feedforward: int = _within(2048, 1, 65536)
    dropout: float = _within(0.1, 0.0, 0.9)
    history: int = _within(70, 1, 10_000)
    horizon: int = _within(5, 1, 1000)

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

    landmark_width: int = _within(256, 2, 8192)
    landmark_weight: float = _within(0.5, 0.0, 1e6)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.landmark_width % 2:
            raise RequestError(f"setting landmark_width={self.landmark_width}: odd; valid: even")


@dataclass(frozen=True)
class CrossAttentionSettings(FusionSettings):
    """Settings of cross-attention; ``attention_width``: of queries, keys, values (d of eq. 1)."""

    cpu: ClassVar[Mapping[str, Any]] = {**FusionSettings.cpu, "attention_width": 128}

    attention_width: int = _within(256, 1, 8192)


@dataclass(frozen=True)
class ResidualSettings(ModelSettings):
    """Settings of residual prediction: sizes of the correction, and weights of the loss.

    Attributes:
        size: side of the images in pixels, seen and predicted.
        pictures: images seen, the last of the history; each but the first beside its difference to
            the one before.
        region: side in pixels of the crops of mouth, eyes and face.
        channels: of the convolutions over the regions, each of which halves them.
        width: of the landmarks' code and of the regions' tokens.
        refiner: channels of the convolutions that refine the warped image.
        dropout: on the inputs of the layers.
        shapes: principal shapes of displacement in which landmarks are predicted.
        history: frames of landmarks that the prior adapts to.
        recent: frames of landmarks, the last of them, that the network sees.
        horizon: frames predicted.
        mouth_weight: of the mouth's absolute error, where the likelihood of it counts 1.
        landmark_weight: of the absolute error of all landmarks.
        picture_weight: of the absolute error of the images.
    """

    cpu: ClassVar[Mapping[str, Any]] = {
        "size": 128,
        "region": 24,
        "channels": (12, 24, 48),
        "width": 48,
        "refiner": 12,
    }

    size: int = field(default=256, metadata={"choices": IMAGE_SIZES})
    pictures: int = _within(4, 2, 64)
    region: int = _within(48, 8, 256)
    channels: tuple[int, ...] = (32, 64, 128)
    width: int = _within(128, 4, 4096)
    refiner: int = _within(32, 1, 1024)
    dropout: float = _within(0.2, 0.0, 0.9)
    shapes: int = _within(8, 2, 64)
    history: int = _within(64, 16, 10_000)
    recent: int = _within(32, 2, 10_000)
    horizon: int = _within(5, 1, 30)
    mouth_weight: float = _within(1.0, 0.0, 1e6)
    landmark_weight: float = _within(0.3, 0.0, 1e6)
    picture_weight: float = _within(10.0, 0.0, 1e6)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in (("recent", self.recent), ("pictures", self.pictures)):
            if value > self.history:
                valid = f"valid: at most history={self.history}"
                raise RequestError(f"setting {name}={value}: too many; {valid}")
        self._require_halvings(self.region, self.channels, least=1)


MODELS: dict[str, tuple[type[ModelSettings], str]] = {
    "image_only": (ApproachSettings, "approaches:ImageOnlyModel"),
    "simple_fusion": (FusionSettings, "approaches:SimpleFusionModel"),
    "cross_attention": (CrossAttentionSettings, "approaches:CrossAttentionModel"),
    "residual": (ResidualSettings, "residual.model:ResidualModel"),
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
# A step has eleven origins of each sequence; what is learnt is small beside the fitted prior.
_CPU_RESIDUAL_TRAINING = replace(
    _CPU_TRAINING, steps=500, batch_size=16, warmup_steps=50, ema_decay=0.99, validate_every=100
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
    training = _CPU_RESIDUAL_TRAINING if model == "residual" else _CPU_TRAINING
    return settings(**settings.cpu), training
