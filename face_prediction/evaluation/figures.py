"""Matplotlib without a window: figures as PNG files, the same bytes for the same data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.evaluation.calibration import LEVELS
from face_prediction.evaluation.statistics import KindSummary
from face_prediction.tracking.geometry import LIPS
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

#: Colours that colour-blind readers can tell apart (Okabe and Ito), for networks.
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Baselines are grey, and told apart by their marks.
GREY = "#888888"
MARKS = ("o", "s", "^", "D", "v", "x", "+", "*")


def new_figure(width: float, height: float, is_laid_out: bool = True) -> Any:
    """An empty figure of this size in inches; its axes make room for their labels, or not.

    Raises:
        RequestError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RequestError(
            f"figures need matplotlib ({error}); pip install "
            "'robo_manip_baselines[face_prediction]', or give --no_figures"
        ) from None
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained" if is_laid_out else None)
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Any, path: Path) -> None:
    """Write ``figure`` to ``path``, whole or not at all.

    Raises:
        RequestError: the folder cannot be written to.
    """
    with atomic_file(path) as temporary:
        # without the name of the program: it would change with matplotlib's version
        figure.savefig(temporary, format="png", metadata={"Software": None})


#: Inches of one panel.
_PANEL = (4.2, 3.6)


def draw_errors(path: Path, summaries: Sequence[KindSummary]) -> None:
    """Distance of the forecast mouth centre against frames ahead, a panel for each kind.

    Bands are 95 % intervals, of the networks and the best baseline.
    """
    figure, panels = _panels(summaries, 1.0)
    handles: dict[str, Any] = {}
    for axes, summary in zip(panels, summaries, strict=True):
        distance = summary.numbers["distance"]
        ahead = np.arange(1, distance.value.shape[1] + 1)
        style = row_styles(summary)
        for i, name in enumerate(summary.rows):
            (line,) = axes.plot(ahead, distance.value[i], **style[name])
            handles.setdefault(name, line)
            if summary.roles[i] == "network" or name == summary.best_baseline:
                axes.fill_between(
                    ahead,
                    distance.low[i],
                    distance.high[i],
                    color=style[name]["color"],
                    alpha=0.15,
                    lw=0,
                )
        axes.set_xticks(ahead)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("frames ahead (1/30 s)")
    panels[0].set_ylabel("mouth centre off by, crops")
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, fontsize="small")
    save_png(figure, path)


def draw_calibration(path: Path, summaries: Sequence[KindSummary]) -> None:
    """Nominal against observed coverage of all forecast frames, a panel for each kind."""
    figure, panels = _panels(summaries, 1.1)
    handles: dict[str, Any] = {}
    nominal = 100 * np.array(LEVELS)
    for axes, summary in zip(panels, summaries, strict=True):
        axes.plot([0, 100], [0, 100], color="black", lw=0.8)
        style = row_styles(summary)
        coverage = summary.numbers["pooled_coverage"]
        for i, name in enumerate(summary.rows):
            if not summary.has_intervals[i]:
                continue
            value, low, high = (100 * v[i] for v in (coverage.value, coverage.low, coverage.high))
            (handles[name],) = axes.plot(nominal, value, **style[name])
            axes.fill_between(nominal, low, high, color=style[name]["color"], alpha=0.15, lw=0)
        axes.set_xlim(0, 100)
        axes.set_ylim(0, 100)
        axes.set_box_aspect(1)
        axes.set_xlabel("nominal coverage, %")
    panels[0].set_ylabel("observed coverage, %")
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, fontsize="small")
    save_png(figure, path)


def row_styles(summary: KindSummary) -> dict[str, dict[str, Any]]:
    """How each row is drawn: networks in colour, baselines grey, the best of them black."""
    result: dict[str, dict[str, Any]] = {}
    networks = others = 0
    for name, role in zip(summary.rows, summary.roles, strict=True):
        if role == "network":
            colour = COLOURS[networks % len(COLOURS)]
            result[name] = {"color": colour, "lw": 2.2, "marker": "o", "ms": 4, "zorder": 3}
            networks += 1
        else:
            colour = "black" if name == summary.best_baseline else GREY
            mark = MARKS[others % len(MARKS)]
            result[name] = {"color": colour, "lw": 1.2, "ls": "--", "marker": mark, "ms": 5}
            others += 1
    return result


def _panels(summaries: Sequence[KindSummary], room: float) -> tuple[Any, Sequence[Any]]:
    """A figure with a titled panel for each kind; ``room`` inches below for the legend."""
    figure = new_figure(_PANEL[0] * len(summaries), _PANEL[1] + room)
    panels = figure.subplots(1, len(summaries), squeeze=False)[0]
    for axes, summary in zip(panels, summaries, strict=True):
        people = "person" if summary.subjects == 1 else "people"
        axes.set_title(
            f"{summary.kind}: {summary.sequences} sequences, {summary.subjects} {people}",
            fontsize="medium",
        )
        axes.grid(alpha=0.3)
    return figure, panels


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
