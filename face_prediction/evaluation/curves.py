"""Plots of an evaluation: error against horizon, and nominal against observed coverage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.evaluation.calibration import LEVELS
from face_prediction.evaluation.canvas import COLOURS, GREY, MARKS, new_figure, save_png
from face_prediction.evaluation.summary import KindSummary

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
