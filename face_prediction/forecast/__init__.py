"""Forecasts of face landmarks that need no training on images: the baselines."""

from __future__ import annotations

from face_prediction.forecast.interface import Forecaster, LandmarkSequences, mouth_centre
from face_prediction.forecast.registry import FORECASTERS, fit_forecaster, restore_forecaster

__all__ = [
    "FORECASTERS",
    "Forecaster",
    "LandmarkSequences",
    "fit_forecaster",
    "mouth_centre",
    "restore_forecaster",
]
