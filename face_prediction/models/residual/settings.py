"""Settings of residual prediction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from face_prediction.models.settings import PICTURE_SIZES, ModelSettings
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class ResidualSettings(ModelSettings):
    """Sizes of the correction to the prior, and what of the loss counts how much.

    Raises:
        RequestError: a value is out of its range.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {},
        "cpu": {"size": 128, "region": 24, "channels": (12, 24, 48), "width": 48, "refiner": 12},
    }

    #: Side of the pictures in pixels, seen and predicted.
    size: int = 256
    #: Pictures at the end of the history that are looked at; each but the first beside the
    #: difference to the one before.
    pictures: int = 4
    #: Side in pixels of what is cut out around mouth, eyes and face.
    region: int = 48
    #: Of the convolutions over the regions, each halving them.
    channels: tuple[int, ...] = (32, 64, 128)
    #: Of the landmarks' code and of the regions' tokens.
    width: int = 128
    #: Channels of the convolutions that refine the warped picture.
    refiner: int = 32
    dropout: float = 0.2
    #: Principal shapes of displacement that landmarks are forecast in.
    shapes: int = 8
    #: Frames of landmarks that the prior adapts to, and that the network sees the last of.
    history: int = 64
    recent: int = 32
    horizon: int = 5
    #: What beside the likelihood of the mouth's error (1) counts: the mouth's absolute error, that
    #: of all landmarks, and that of the pictures.
    mouth_weight: float = 1.0
    landmark_weight: float = 0.3
    picture_weight: float = 10.0

    def __post_init__(self) -> None:
        self.require_one_of("size", PICTURE_SIZES)
        for name, low, high in (
            ("pictures", 2, 64),
            ("region", 8, 256),
            ("width", 4, 4096),
            ("refiner", 1, 1024),
            ("dropout", 0.0, 0.9),
            ("shapes", 2, 64),
            ("history", 16, 10_000),
            ("recent", 2, self.history),
            ("horizon", 1, 30),
            ("mouth_weight", 0.0, 1e6),
            ("landmark_weight", 0.0, 1e6),
            ("picture_weight", 0.0, 1e6),
        ):
            self.require(name, low, high)
        if self.pictures > self.history:
            raise RequestError(f"setting pictures={self.pictures}: at most history={self.history}")
        if not self.channels or min(self.channels) < 1 or self.region >> len(self.channels) < 1:
            raise RequestError(
                f"setting channels={self.channels}: 1 or more halvings of a region of "
                f"{self.region} pixels, each with 1 or more channels"
            )
