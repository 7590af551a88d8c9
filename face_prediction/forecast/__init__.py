"""Forecasts of face landmarks that need no training on images: the baselines, by name.

A further forecaster is a class and a line here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from face_prediction.forecast.autoregression import LandmarkAutoregression, MouthAutoregression
from face_prediction.forecast.extrapolation import (
    ConstantVelocity,
    KalmanConstantVelocity,
    LineFit,
    Persistence,
)
from face_prediction.forecast.interface import Forecaster, LandmarkSequences, mouth_centre
from robo_manip_baselines.runs.errors import require_choice

__all__ = [
    "FORECASTERS",
    "Forecaster",
    "LandmarkSequences",
    "fit_forecaster",
    "mouth_centre",
    "restore_forecaster",
]

FORECASTERS: dict[str, type[Forecaster]] = {
    kind.name: kind
    for kind in (
        Persistence,
        ConstantVelocity,
        LineFit,
        MouthAutoregression,
        LandmarkAutoregression,
        KalmanConstantVelocity,
    )
}


def fit_forecaster(name: str, sequences: LandmarkSequences) -> Forecaster:
    """Fit the forecaster called ``name``.

    Raises:
        RequestError: there is none of that name, or the sequences do not suit it.
    """
    return FORECASTERS[require_choice("forecaster", name, FORECASTERS)].fit(sequences)


def restore_forecaster(name: str, arrays: Mapping[str, NDArray[Any]]) -> Forecaster:
    """The forecaster ``name`` whose ``arrays()`` were stored.

    Raises:
        RequestError: there is none of that name, or the arrays are not its own.
    """
    return FORECASTERS[require_choice("forecaster", name, FORECASTERS)].from_arrays(arrays)
