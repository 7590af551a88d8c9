"""How far forecasts are off, how sure that is, and what of it the robot's side is told."""

from __future__ import annotations

from face_prediction.evaluation.error_stats import (
    PAPER_CAMERA,
    Camera,
    ErrorStats,
    ResidualRun,
    data_hash,
    load_error_stats,
    measure_error_stats,
    save_error_stats,
)
from face_prediction.evaluation.errors import (
    MouthErrors,
    mouth_distances,
    mouth_errors,
    mouth_residuals,
    normalised_mean_errors,
    skill,
)
from face_prediction.evaluation.statistics import Interval, cluster_bootstrap

__all__ = [
    "PAPER_CAMERA",
    "Camera",
    "ErrorStats",
    "Interval",
    "MouthErrors",
    "ResidualRun",
    "cluster_bootstrap",
    "data_hash",
    "load_error_stats",
    "measure_error_stats",
    "mouth_distances",
    "mouth_errors",
    "mouth_residuals",
    "normalised_mean_errors",
    "save_error_stats",
    "skill",
]
