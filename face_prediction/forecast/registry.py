"""The forecasters by name; adding one is a module and a line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from face_prediction.forecast.autoregression import LandmarkAutoregression, MouthAutoregression
from face_prediction.forecast.interface import Forecaster, LandmarkSequences
from face_prediction.forecast.kalman import KalmanConstantVelocity
from face_prediction.forecast.simple import ConstantVelocity, Line, Persistence
from robo_manip_baselines.runs.errors import RequestError

FORECASTERS: dict[str, type[Forecaster]] = {
    kind.name: kind
    for kind in (
        Persistence,
        ConstantVelocity,
        Line,
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
    return _kind(name).fit(sequences)


def restore_forecaster(name: str, arrays: Mapping[str, NDArray[Any]]) -> Forecaster:
    """The forecaster ``name`` whose ``arrays()`` were stored.

    Raises:
        RequestError: there is none of that name, or the arrays are not its own.
    """
    return _kind(name).from_arrays(arrays)


def _kind(name: str) -> type[Forecaster]:
    if name not in FORECASTERS:
        raise RequestError(f"forecaster '{name}'; there are {', '.join(FORECASTERS)}")
    return FORECASTERS[name]
