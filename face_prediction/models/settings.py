"""How a network is trained: one frozen record, kept in its checkpoint."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self

    from face_prediction.models.interface import PredictorModel


Schedule = Literal["constant", "cosine"]
Precision = Literal["auto", "fp32", "bf16"]


@dataclass(frozen=True)
class TrainSettings:
    """Everything that the weights depend on, beside network, data and seed.

    Raises:
        RequestError: a value is out of its range; the message names the option.
    """

    steps: int
    batch_size: int
    #: Of Adam; 1e-4 in the paper (IV.B).
    learning_rate: float = 1e-4
    #: cosine: down to a hundredth of the learning rate at the last step.
    schedule: Schedule = "constant"
    #: Steps over which the learning rate rises from 0.
    warmup_steps: int = 0
    #: Longest gradient; 0: any.
    clip_norm: float = 1.0
    #: Of the moving average of the weights, which is then validated and kept; 0: none.
    ema_decay: float = 0.0
    #: Turn half of the sequences left to right, and make them lighter or darker.
    augment: bool = False
    #: auto: bf16 on a GPU, fp32 elsewhere.
    precision: Precision = "auto"
    #: Steps between looks at the fold that is held out.
    validate_every: int = 500
    #: Sequences of it that are looked at, evenly spread; 0: all.
    validation_sequences: int = 96

    def __post_init__(self) -> None:
        for name, low, high in (
            ("steps", 1, 1_000_000_000),
            ("batch_size", 1, 65536),
            ("learning_rate", 0.0, 10.0),
            ("warmup_steps", 0, 1_000_000_000),
            ("clip_norm", 0.0, 1e9),
            ("ema_decay", 0.0, 0.999999),
            ("validate_every", 1, 1_000_000_000),
            ("validation_sequences", 0, 1_000_000_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise RequestError(f"--{name} {value}: between {low} and {high:g}")
        for name, choices in (
            ("schedule", ("constant", "cosine")),
            ("precision", ("auto", "fp32", "bf16")),
        ):
            if getattr(self, name) not in choices:
                raise RequestError(f"--{name} {getattr(self, name)}: one of {', '.join(choices)}")

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of the step after ``step`` steps."""
        rate = self.learning_rate * min((step + 1) / (self.warmup_steps + 1), 1.0)
        if self.schedule == "cosine":
            done = max(step - self.warmup_steps, 0) / max(self.steps - self.warmup_steps, 1)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))
        return rate

    def to_json(self) -> dict[str, Any]:
        """Plain values, what `from_json` takes."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> TrainSettings:
        """Undo `to_json`.

        Raises:
            RequestError: other keys, or values that are none of settings.
        """
        names = {item.name for item in fields(cls)}
        if not isinstance(data, dict) or set(data) != names:
            raise RequestError(f"training settings need the keys {', '.join(sorted(names))}")
        try:
            return cls(**data)
        except TypeError as error:
            raise RequestError(f"training settings are not as expected ({error})") from None


#: Sides of the pictures that a network can be shown: 256 and what JPEG decodes at once.
PICTURE_SIZES = (32, 64, 128, 256)


@dataclass(frozen=True)
class ModelSettings:
    """Base of every network's settings: JSON, and values given by name.

    Every field of a subclass has a default, a plain number, truth value, text or a tuple of
    whole numbers; what is read back must be of the same kind.
    """

    #: Values that differ from the defaults, by the name of the preset.
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}, "cpu": {}}

    @classmethod
    def preset(cls, name: str) -> Self:
        """The settings of the preset ``name``.

        Raises:
            RequestError: there is none of that name.
        """
        if name not in cls.presets:
            raise RequestError(f"--preset {name}: one of {', '.join(cls.presets)}")
        return cls(**cls.presets[name])

    def to_json(self) -> dict[str, Any]:
        """Plain values, what `from_json` takes."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """Undo `to_json`.

        Raises:
            RequestError: other keys, or a value that is none of a setting.
        """
        names = {item.name for item in fields(cls)}
        if not isinstance(data, Mapping) or set(data) != names:
            raise RequestError(f"{cls.__name__} needs the keys {', '.join(sorted(names))}")
        return cls().changed(data)

    def changed(self, values: Mapping[str, Any]) -> Self:
        """These settings with other values, by name.

        Raises:
            RequestError: a name or a value is none of these settings.
        """
        defaults = {item.name: getattr(self, item.name) for item in fields(self)}
        for name in values:
            if name not in defaults:
                raise RequestError(f"setting '{name}'; there are {', '.join(defaults)}")
        return replace(self, **{k: _like(k, v, defaults[k]) for k, v in values.items()})

    def require(self, name: str, low: float, high: float) -> None:
        """Check that the number ``name`` is in its range.

        Raises:
            RequestError: it is not.
        """
        value = getattr(self, name)
        if not low <= value <= high:
            raise RequestError(f"setting {name}={value}: between {low} and {high}")

    def require_one_of(self, name: str, choices: Sequence[object]) -> None:
        """Check that ``name`` is one of ``choices``.

        Raises:
            RequestError: it is not.
        """
        value = getattr(self, name)
        if value not in choices:
            raise RequestError(f"setting {name}={value}: one of {', '.join(map(str, choices))}")


def _like(name: str, value: Any, default: Any) -> Any:
    """``value`` as the type of ``default``, where that changes nothing."""
    if isinstance(default, tuple):
        if isinstance(value, (list, tuple)) and all(type(item) is int for item in value):
            return tuple(value)
        raise RequestError(f"setting {name}={value}: a list of whole numbers")
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if type(value) is not type(default):
        raise RequestError(f"setting {name}={value}: a {type(default).__name__}, like {default}")
    return value


@dataclass(frozen=True)
class ApproachSettings(ModelSettings):
    """What the three published approaches share; image-only prediction needs no more.

    The paper (IV.A) gives the sizes of pictures, history and horizon and the four layers. Widths,
    heads, the depth of the convolutions and dropout are ours.

    Raises:
        RequestError: a value is out of its range.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {},
        "cpu": {
            "size": 64,
            "channels": (8, 16, 32, 64),
            "width": 128,
            "heads": 4,
            "feedforward": 256,
            "dropout": 0.0,
        },
    }

    #: Side of the pictures in pixels, seen and predicted.
    size: int = 256
    #: Of the convolutions that each halve the picture; the decoder has the same in reverse.
    channels: tuple[int, ...] = (32, 64, 128, 256, 256, 256)
    #: Of the tokens that the Transformer works on.
    width: int = 512
    #: Of the Transformer encoder.
    heads: int = 8
    layers: int = 4
    feedforward: int = 2048
    dropout: float = 0.1
    #: Frames seen and predicted.
    history: int = 70
    horizon: int = 5

    def __post_init__(self) -> None:
        self.require_one_of("size", PICTURE_SIZES)
        for name, low, high in (
            ("width", 2, 8192),
            ("heads", 1, 128),
            ("layers", 1, 64),
            ("feedforward", 1, 65536),
            ("dropout", 0.0, 0.9),
            ("history", 1, 10_000),
            ("horizon", 1, 1000),
        ):
            self.require(name, low, high)
        if self.width % (2 * self.heads):
            raise RequestError(f"setting width={self.width}: a multiple of 2 heads={self.heads}")
        if not self.channels or min(self.channels) < 1 or self.size >> len(self.channels) < 2:
            raise RequestError(
                f"setting channels={self.channels}: 1 or more halvings of {self.size} pixels, "
                "which leave at least 2, each with 1 or more channels"
            )


@dataclass(frozen=True)
class FusionSettings(ApproachSettings):
    """Settings of simple fusion: landmarks come in and go out too."""

    #: Of the landmark features (D_l of the paper).
    landmark_width: int = 256
    #: What the landmarks' error counts beside the picture's (paper, equation 5).
    landmark_weight: float = 0.5

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        name: {**values, **({"landmark_width": 64} if name == "cpu" else {})}
        for name, values in ApproachSettings.presets.items()
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("landmark_width", 2, 8192)
        if self.landmark_width % 2:
            raise RequestError(f"setting landmark_width={self.landmark_width}: an even number")
        self.require("landmark_weight", 0.0, 1e6)


@dataclass(frozen=True)
class CrossAttentionSettings(FusionSettings):
    """Settings of cross-attention fusion."""

    #: Of the projected vectors (d of the paper's equation 1).
    attention_width: int = 256

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        name: {**values, **({"attention_width": 128} if name == "cpu" else {})}
        for name, values in FusionSettings.presets.items()
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("attention_width", 1, 8192)


_PACKAGE = "face_prediction.models"
#: name -> where its settings are (without torch), and the network that is made from them
MODELS: dict[str, tuple[str, str]] = {
    "image_only": ("settings:ApproachSettings", "approaches:ImageOnlyModel"),
    "simple_fusion": ("settings:FusionSettings", "approaches:SimpleFusionModel"),
    "cross_attention": ("settings:CrossAttentionSettings", "approaches:CrossAttentionModel"),
    "residual": ("residual.settings:ResidualSettings", "residual.model:ResidualModel"),
}


def settings_class(name: str) -> type[ModelSettings]:
    """The class of the settings of the network called ``name``.

    Raises:
        RequestError: there is none of that name.
    """
    kind: type[ModelSettings] = _load(_entry(name)[0])
    return kind


def make_model(name: str, settings: ModelSettings) -> PredictorModel:
    """The network called ``name``, with weights drawn from torch's generator.

    Raises:
        RequestError: there is none of that name.
    """
    model: PredictorModel = _load(_entry(name)[1])(settings)
    return model


def _entry(name: str) -> tuple[str, str]:
    if name not in MODELS:
        raise RequestError(f"model '{name}'; there are {', '.join(MODELS)}")
    return MODELS[name]


def _load(place: str) -> Any:
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(f"{_PACKAGE}.{module}"), attribute)


PRESETS = ("paper", "cpu")

#: The paper's training is Adam at 1e-4 (IV.B); how long, on how many sequences at once, it does
#: not say. The cpu preset has minutes: it needs larger steps, and a schedule that ends them.
_TRAINING = {
    "paper": TrainSettings(steps=20_000, batch_size=16, learning_rate=1e-4, augment=False),
    "cpu": TrainSettings(
        steps=1600,
        batch_size=4,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_steps=100,
        augment=True,
        validate_every=400,
    ),
}
#: Where a network is trained otherwise than the three published approaches.
_TRAINING_OF: dict[tuple[str, str], TrainSettings] = {
    # a step holds eleven origins of each sequence; what is learnt is small beside the fitted prior
    ("residual", "cpu"): TrainSettings(
        steps=500,
        batch_size=16,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_steps=50,
        ema_decay=0.99,
        augment=True,
        validate_every=100,
    ),
}


def preset_settings(model: str, preset: str) -> tuple[ModelSettings, TrainSettings]:
    """Settings of network and training.

    Raises:
        RequestError: there is no such network or preset.
    """
    if preset not in PRESETS:
        raise RequestError(f"--preset {preset}: one of {', '.join(PRESETS)}")
    training = _TRAINING_OF.get((model, preset), _TRAINING[preset])
    return settings_class(model).preset(preset), training
