"""Whether a file is a library of recorded face motion as `face_prediction` writes it.

Shapes: N frames of the whole library, R runs, H = 5 frames of a prediction.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.observation import MAX_HORIZON
from robo_manip_baselines.observation.corruption import FRAME_RATE

SCHEMA = "recorded_face_motion"
VERSION = 1

_ARRAYS = {
    "time": (1, "f"),
    "mouth": (2, "f"),
    "orientation": (2, "f"),
    "jaw": (1, "f"),
    "run_start": (1, "i"),
    "run_length": (1, "i"),
    "run_clip": (1, "U"),
    "run_subject": (1, "U"),
}

PREDICTION = "predicted_mouth"
"""(N, H, 3), the one array that a library may lack."""


def find_problem(content: dict[str, NDArray[Any]]) -> str | None:
    """Return what is wrong with the arrays of a library file, or None."""
    if str(content.get("schema")) != SCHEMA:
        return f"schema is '{content.get('schema')}', not '{SCHEMA}'"
    if str(content.get("version")) != str(VERSION):
        return f"version is {content.get('version')}, this release reads {VERSION}"
    fps = content.get("fps", np.array(0.0))
    if fps.shape or fps.dtype.kind not in "fi" or not 0.0 < float(fps) < np.inf:
        return "'fps' must be one positive number"
    try:
        json.loads(str(content["metadata"]))
    except (KeyError, ValueError):
        return "'metadata' is missing or not JSON"
    for name, (ndim, kind) in _ARRAYS.items():
        if name not in content:
            return f"'{name}' is missing"
        if content[name].ndim != ndim or content[name].dtype.kind != kind:
            return f"'{name}' has shape {content[name].shape} and type {content[name].dtype}"
        if kind == "f" and not np.isfinite(content[name]).all():
            return f"'{name}' holds values that are not finite"
    frames = len(content["time"])
    if content["mouth"].shape != (frames, 3) or content["orientation"].shape != (frames, 4):
        return "'mouth' and 'orientation' must have a row per frame, of 3 and 4 numbers"
    if len(content["jaw"]) != frames:
        return "'jaw' must have a number per frame"
    if problem := _prediction_problem(content, frames):
        return problem
    if not np.allclose(np.linalg.norm(content["orientation"], axis=1), 1.0, atol=1e-3):
        return "'orientation' holds quaternions that are not of unit length"
    start, length = content["run_start"], content["run_length"]
    counts = {len(content[name]) for name in ("run_start", "run_length", "run_clip", "run_subject")}
    if len(counts) != 1:
        return "the run_* arrays differ in length"
    if (start < 0).any() or (length < 1).any() or (start + length > frames).any():
        return "a run lies outside the frames"
    return None


def _prediction_problem(content: dict[str, NDArray[Any]], frames: int) -> str | None:
    """Return what is wrong with the predictions of a library file, if it has any, or None."""
    predicted = content.get(PREDICTION)
    if predicted is None:
        return None
    shape = (frames, MAX_HORIZON, 3)
    if predicted.shape != shape or predicted.dtype.kind != "f":
        return f"'{PREDICTION}' has shape {predicted.shape} and type {predicted.dtype}, not {shape}"
    if not np.isfinite(predicted).all():
        return f"'{PREDICTION}' holds values that are not finite"
    if float(content["fps"]) != FRAME_RATE:
        return f"'{PREDICTION}' is of frames at {FRAME_RATE:g} a second, 'fps' is {content['fps']}"
    return None
