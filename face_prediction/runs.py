"""Cutting a motion into runs from which any start gives a whole episode within reach.

An episode draws its start uniformly from the starts of a run that leave a window (12 s) before
the run's end, and moves by the displacement from that start. So every such start, not only the
first, must keep the window within reach.

Legend: T frames, W frames in a window.
"""

from __future__ import annotations

import numpy as np


def permitted_starts(mouth: np.ndarray, window: int, max_displacement: float) -> np.ndarray:
    """(T - W + 1,) bool: from which frames a window of W frames stays within reach.

    Within reach: no axis of ``mouth`` (T, 3) goes further than ``max_displacement`` metres from
    where it was in the window's first frame.
    """
    if len(mouth) < window:
        return np.zeros(0, dtype=bool)
    views = np.lib.stride_tricks.sliding_window_view(mouth, window, axis=0)  # (N, 3, W)
    start = mouth[: len(views)]
    reach = np.maximum(views.max(axis=2) - start, start - views.min(axis=2))
    return np.all(reach <= max_displacement, axis=1)


def longest_runs(permitted: np.ndarray, window: int) -> list[tuple[int, int]]:
    """Disjoint [start, stop) runs that hold the most frames and permit every start in them.

    Dynamic programming over the frame where a run stops: a run that stops at e may begin at any s
    for which all starts s ... e - W are permitted.
    """
    frames = len(permitted) + window - 1
    best = np.zeros(frames + 1, dtype=int)  # most frames in runs that stop by here
    chosen: list[int | None] = [None] * (frames + 1)  # where the run that stops here begins
    open_start: int | None = None  # best beginning among the permitted starts up to e - W
    for stop in range(1, frames + 1):
        best[stop] = best[stop - 1]
        last_start = stop - window
        if last_start < 0:
            continue
        if not permitted[last_start]:
            open_start = None
            continue
        if open_start is None or best[last_start] - last_start > best[open_start] - open_start:
            open_start = last_start
        held = best[open_start] + stop - open_start
        if held > best[stop]:
            best[stop] = held
            chosen[stop] = open_start
    runs: list[tuple[int, int]] = []
    stop = frames
    while stop > 0:
        start = chosen[stop]
        if start is None:
            stop -= 1
        else:
            runs.append((start, stop))
            stop = start
    return runs[::-1]
