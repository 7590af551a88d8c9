"""How far forecasts are off, how sure that is, and what of it the robot's side is told."""

from __future__ import annotations

from face_prediction.evaluation.bootstrap import Interval, cluster_bootstrap
from face_prediction.evaluation.camera import PAPER_CAMERA, Camera
from face_prediction.evaluation.error_stats import ErrorStats, ResidualRun
from face_prediction.evaluation.error_stats_file import load_error_stats, save_error_stats
from face_prediction.evaluation.landmark_errors import normalised_mean_errors
from face_prediction.evaluation.mouth_errors import (
    MouthErrors,
    mouth_distances,
    mouth_errors,
    mouth_residuals,
    skill,
)
from face_prediction.evaluation.residuals import data_hash, measure_error_stats

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
