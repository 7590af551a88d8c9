"""The landmarks seen so far at the predictor's rate, whatever the camera's is.

Everything is counted back from the newest frame, so that nothing waits for a later one: the
history is what was seen 0, 1, 2, ... thirtieths of a second before it, between two frames on the
straight line, and before the first frame at rest.

Legend: N frames seen, T frames of history, L = 468 landmarks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from face_prediction.resample import SAME_TIME


def times_back(now: float, count: int, fps: float) -> NDArray[np.float64]:
    """The last ``count`` times (T,) of a history that ends at ``now``, the newest last."""
    return now - np.arange(count - 1, -1, -1) / fps


def landmarks_at(
    wanted: NDArray[np.float64],
    times: NDArray[np.float64],
    landmarks: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Landmarks (T, L, C) at ``wanted`` (T,), none later than the last of ``times``.

    Args:
        wanted: s; a time less than a millisecond from a frame's is that frame's.
        times: (N,) s, increasing.
        landmarks: (N, L, C).
    """
    after = np.clip(np.searchsorted(times, wanted - SAME_TIME), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = times[after] - times[before]
    weight = np.divide(wanted - times[before], gap, out=np.ones_like(wanted), where=gap > 0)
    # a time at a frame takes nothing from its neighbour, and one before the first has none
    weight = np.where(times[after] - wanted < SAME_TIME, 1.0, np.clip(weight, 0.0, 1.0))
    result = landmarks[after].astype(np.float64)
    made = weight < 1.0
    part = weight[made, None, None]
    result[made] = (1 - part) * landmarks[before[made]] + part * result[made]
    return result


def nearest(wanted: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (T,) of the frame nearest to each of ``wanted`` (T,); of two as near, the earlier."""
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    is_later = wanted - times[before] > times[after] - wanted + SAME_TIME
    return np.where(is_later, after, before)
