"""Errors of the forecasts in a motion library, frame by frame.

Legend: N forecasts, H horizon.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.evaluation import ErrorStats
from face_prediction.evaluation.error_stats import ResidualRun
from face_prediction.library import MotionLibrary


@dataclass(frozen=True)
class LibraryResiduals:
    """Signed errors of N forecasts, and where each is from."""

    #: (N, H, 2) m across the view: to the right, and down as V is
    metres: NDArray[np.float64]
    clips: tuple[str, ...]
    subjects: tuple[str, ...]
    #: frames counted through each clip's runs, one apart within a run and further between runs
    starts: tuple[int, ...]


def library_residuals(library: MotionLibrary, clips: Collection[str]) -> LibraryResiduals:
    """Errors of every forecast in the runs of ``clips`` whose H frames the run holds.

    Raises:
        RequestError: the library holds no forecasts, or none of these clips.
    """
    if library.predicted_mouth is None:
        raise RequestError("--library: holds no forecasts; make it with face-prediction predict")
    parts: list[NDArray[np.float64]] = []
    names: list[str] = []
    people: list[str] = []
    starts: list[int] = []
    horizon = library.predicted_mouth.shape[1]
    for index, name in enumerate(library.run_clip.tolist()):
        part = library.run(index)
        count = part.stop - part.start - horizon
        if name not in clips or count < 1:
            continue
        mouth = library.mouth[part].astype(np.float64)
        ahead = library.predicted_mouth[part].astype(np.float64)
        came = np.stack([mouth[h : h + count] for h in range(1, horizon + 1)], axis=1)
        apart = ahead[:count] - came
        parts.append(apart[..., :2] * (1.0, -1.0))  # y is up, V is down
        names += [name] * count
        people += [str(library.run_subject[index])] * count
        starts += range(part.start, part.start + count)
    if not parts:
        raise RequestError(f"--library: has no run of the clips {', '.join(sorted(clips))}")
    return LibraryResiduals(np.concatenate(parts), tuple(names), tuple(people), tuple(starts))


def shortened(stats: ErrorStats, frames: int) -> ErrorStats:
    """``stats`` with at most so many forecasts of each clip kept as runs, its longest runs first.

    A file that holds every forecast of minutes is large, and no more is needed to draw from.
    """
    room: dict[str, int] = {}
    kept: list[ResidualRun] = []
    for run in sorted(stats.residuals, key=lambda run: -len(run.values)):
        count = min(len(run.values), frames - room.get(run.clip, 0))
        if count < 1:
            continue
        room[run.clip] = room.get(run.clip, 0) + count
        kept.append(replace(run, values=run.values[:count]))
    return replace(stats, residuals=tuple(kept))
