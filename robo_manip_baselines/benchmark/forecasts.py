"""Forecasts without information about the future, as controls for the benefit of a prediction.

They are written into a library of recorded motion in place of a predictor's output, so that
environments and episode files carry them like any other prediction.

Legend: N frames of the library, H = 24 frames ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face.motion import (
    LIBRARY_FILE,
    PREDICTION,
    MotionLibrary,
    read_library,
)
from robo_manip_baselines.observation import MAX_HORIZON
from robo_manip_baselines.runs.npz import write_npz


def persistence(library: MotionLibrary) -> NDArray[np.float64]:
    """Forecast, (N, H, 3) m, that the mouth stays where it is."""
    return np.repeat(library.mouth[:, None], MAX_HORIZON, axis=1)


def shuffled(library: MotionLibrary) -> NDArray[np.float64]:
    """Forecast, (N, H, 3) m, that the mouth moves as it did half a library away.

    Its speeds are those of a forecast, and it is independent of the future.
    """
    frame = np.arange(len(library.mouth))
    last = frame.copy()
    for start, length in zip(library.run_start, library.run_length, strict=True):
        last[start : start + length] = start + length - 1
    ahead = np.minimum(frame[:, None] + np.arange(1, MAX_HORIZON + 1), last[:, None])
    moves = library.mouth[ahead] - library.mouth[:, None]
    return library.mouth[:, None] + np.roll(moves, len(moves) // 2, axis=0)


FORECASTS: dict[str, Callable[[MotionLibrary], NDArray[np.float64]]] = {
    "persistence": persistence,
    "shuffled": shuffled,
}


def write_library(path: Path, source: Path | None, forecast: str) -> None:
    """Write a copy of a library with a forecast as its predictions.

    Args:
        path: to write to.
        source: library to copy; the one that ships with the package if None.
        forecast: name in ``FORECASTS``.

    Raises:
        RequestError: the library cannot be used.
    """
    library = MotionLibrary.load(source)
    content = {
        "schema": np.array(LIBRARY_FILE.schema),
        "version": np.array(LIBRARY_FILE.version),
        **read_library(library.source),
    }
    content[PREDICTION] = FORECASTS[forecast](library).astype(np.float32)
    write_npz(path, content)
