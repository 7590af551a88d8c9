"""The networks by name; adding one is a module and a line here. Loads torch only to make one."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from face_prediction.errors import RequestError
from face_prediction.models.settings import ModelSettings

if TYPE_CHECKING:
    from face_prediction.models.interface import PredictorModel

_PACKAGE = "face_prediction.models"
#: name -> where its settings are (without torch), and the network that is made from them
MODELS: dict[str, tuple[str, str]] = {
    "image_only": ("settings:ApproachSettings", "image_only:ImageOnlyModel"),
    "simple_fusion": ("settings:FusionSettings", "simple_fusion:SimpleFusionModel"),
    "cross_attention": ("settings:CrossAttentionSettings", "cross_attention:CrossAttentionModel"),
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
