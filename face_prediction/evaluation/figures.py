"""Figures like 4 to 6 of the paper: truth and forecast, with and without landmarks.

Legend: H horizon, L = 468 landmarks, S side of the pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.evaluation.canvas import new_figure, save_png
from face_prediction.lifting import LIPS

#: Of the mouth's landmarks, and of the others (paper, section IV.B).
MOUTH_COLOUR, OTHER_COLOUR = "#00E000", "white"
#: Inches from one picture to the next, and to the left, above and on the other sides of all.
_STEP, _LEFT, _TOP, _EDGE = 2.3, 0.3, 0.65, 0.08
#: Room between two, in pictures.
_GAP = 0.03


@dataclass(frozen=True)
class Shown:
    """Pictures (H, S, S, 3) and landmarks (H, L, 2), NaN where there are none."""

    pictures: NDArray[np.uint8]
    landmarks: NDArray[np.floating]


def draw_forecast(
    path: Path, title: str, frames: Sequence[int], truth: Shown, forecast: Shown
) -> None:
    """A column for each frame; truth, truth with landmarks, forecast, forecast with landmarks."""
    rows = (
        ("truth", truth, False),
        ("truth, landmarks", truth, True),
        ("forecast", forecast, False),
        ("forecast, landmarks", forecast, True),
    )
    # squares of known size: a layout that looks for the best takes seconds for twenty of them
    width = _LEFT + _STEP * len(frames) + _EDGE
    height = _TOP + _STEP * len(rows) + _EDGE
    figure = new_figure(width, height, is_laid_out=False)
    figure.suptitle(title, y=1 - 0.1 / height, va="top")
    grid = figure.subplots(len(rows), len(frames), squeeze=False)
    figure.subplots_adjust(
        left=_LEFT / width,
        bottom=_EDGE / height,
        right=1 - _EDGE / width,
        top=1 - _TOP / height,
        wspace=_GAP,
        hspace=_GAP,
    )
    for line, (label, shown, with_landmarks) in zip(grid, rows, strict=True):
        for column, axes in enumerate(line):
            axes.imshow(shown.pictures[column], extent=(0, 1, 1, 0), interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            if with_landmarks:
                _dots(axes, shown.landmarks[column])
            axes.set_xlim(0, 1)
            axes.set_ylim(1, 0)
        line[0].set_ylabel(label)
    for axes, frame in zip(grid[0], frames, strict=True):
        axes.set_title(f"frame {frame}")
    save_png(figure, path)


def _dots(axes: Any, landmarks: NDArray[np.floating]) -> None:
    if not np.isfinite(landmarks).all():
        axes.text(0.5, 0.5, "no face found", ha="center", va="center", color="white",
                  bbox={"facecolor": "black", "alpha": 0.6})  # fmt: skip
        return
    is_mouth = np.zeros(len(landmarks), dtype=bool)
    is_mouth[list(LIPS)] = True
    for part, colour, size in ((~is_mouth, OTHER_COLOUR, 1.6), (is_mouth, MOUTH_COLOUR, 4.5)):
        axes.scatter(*landmarks[part].T, s=size, c=colour, linewidths=0)
