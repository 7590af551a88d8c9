"""What shapes a network: frozen records that need no torch, kept as JSON beside the weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from face_prediction.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self

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
