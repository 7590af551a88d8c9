"""Figures as PNG files, the same bytes for the same data.

``errors.png`` and ``calibration.png`` are plots; ``forecast_KIND_ROW.png`` has images of faces.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.image_batches import SequenceBatch
from face_prediction.evaluation.scoring import LEVELS, EvaluationScores
from face_prediction.evaluation.setup import PERSISTENCE, EvaluationSetup
from face_prediction.evaluation.statistics import KindSummary
from face_prediction.evaluation.tracks import FAR, TrackScores
from face_prediction.prediction.errors import mouth_distances
from face_prediction.prediction.interface import Forecast
from face_prediction.tracking.geometry import LIPS
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.files import atomic_file

COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of networks, which colour-blind readers can tell apart (Okabe and Ito)."""
GREY = "#888888"
MARKS = ("o", "s", "^", "D", "v", "x", "+", "*")  # tell the baselines apart, which are grey
MOUTH_COLOUR, OTHER_COLOUR = "#00E000", "white"  # of landmarks (paper, section IV.B)
_LIVELIER_THAN = 0.9  # share of a kind that moves less than the sequence in the figures
_PANEL = (4.2, 3.6)  # inches
# inches from one image to the next, and to the left, above and on the other sides of all
_STEP, _LEFT, _TOP, _EDGE = 2.3, 0.3, 0.65, 0.08
_GAP = 0.03  # between two images, in images


def new_matplotlib_figure(width: float, height: float, layout: str | None = "constrained") -> Any:
    """An empty figure of this size in inches, without a window.

    Raises:
        RequestError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RequestError(
            f"figures need matplotlib ({error}); give --no_figures, or run: "
            f"{install_command('face-prediction')}"
        ) from None
    figure = Figure(figsize=(width, height), dpi=100, layout=layout)  # pyright: ignore
    FigureCanvasAgg(figure)
    return figure


def write_figures(
    folder: Path, setup: EvaluationSetup, scores: EvaluationScores, summaries: Sequence[KindSummary]
) -> list[Path]:
    """Write all figures, and return their paths.

    Raises:
        RequestError: matplotlib is not installed, or the folder cannot be written to.
    """
    written = [folder / "errors.png"]
    draw_errors(written[0], summaries)
    if with_intervals := [s for s in summaries if any(row.has_intervals for row in s.rows)]:
        written.append(folder / "calibration.png")
        draw_calibration(written[-1], with_intervals)
    for summary in summaries:
        place = _lively_sequence(scores, summary.kind)
        index, row = int(setup.selection.indices[place]), setup.selection.rows[place]
        for predictor in setup.predictors:
            if not (size := predictor.image_size):
                continue
            batch = SequenceBatch(setup.dataset, [index], predictor.needs, [size])
            truth = Forecast(batch.future, batch.future_images(size))
            name = re.sub(r"\W+", "_", predictor.name).strip("_")
            path = folder / f"forecast_{summary.kind}_{name}.png"
            title = f"{predictor.name}, {summary.kind}: clip {row.clip}"
            first = setup.dataset.manifest.settings.history + 1
            draw_forecast(path, title, first, truth, predictor.forecast([row], batch))
            written.append(path)
    return written


def draw_errors(path: Path, summaries: Sequence[KindSummary]) -> None:
    """Distance of the forecast mouth centre against frames ahead, a panel for each kind.

    Bands are 95 % intervals, of the networks and the best baseline.
    """
    ahead = np.arange(1, summaries[0].horizon + 1)
    figure, panels = _draw_curves(summaries, "distance", ahead)
    for axes in panels:
        axes.set_xticks(ahead)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("frames ahead (1/30 s)")
    panels[0].set_ylabel("mouth centre off by, crops")
    _save_png(figure, path)


def draw_calibration(path: Path, summaries: Sequence[KindSummary]) -> None:
    """Nominal against observed coverage of all forecast frames, a panel for each kind."""
    percent = 100 * np.array(LEVELS)
    figure, panels = _draw_curves(summaries, "pooled_coverage", percent, is_coverage=True)
    for axes in panels:
        axes.plot([0, 100], [0, 100], color="black", lw=0.8)
        axes.set(xlim=(0, 100), ylim=(0, 100), box_aspect=1, xlabel="nominal coverage, %")
    panels[0].set_ylabel("observed coverage, %")
    _save_png(figure, path)


MOST_NAMES = 12
"""People whose names are written beside their dots; more would overlap."""


def draw_gains(path: Path, all_scores: Sequence[TrackScores]) -> list[Path]:
    """Error of the first network against the best baseline's, by the smoothness of the motion.

    A dot is a person, the larger the more frames there are of them; frames 3-5 of whole tracks. Up
    to `MOST_NAMES` people are named. Without a network that forecasts whole tracks there is no
    figure.

    Returns:
        The path, if it was drawn.
    """
    networks = [[i for i, (_, role) in enumerate(s.rows) if role == "network"] for s in all_scores]
    if not any(networks):
        return []
    figure = new_matplotlib_figure(6.4, 4.8)
    axes = figure.subplots()
    names: set[str] = set()
    is_named = sum(len(scores.subjects) for scores in all_scores) <= MOST_NAMES
    for scores, rows, colour in zip(all_scores, networks, COLOURS, strict=False):
        if not rows:
            continue
        best = np.maximum(scores.errors[:, scores.best, FAR], 1e-300)
        gain = 100 * (scores.errors[:, rows[0], FAR] / best - 1)
        seen = scores.counts[:, FAR] > 0
        size = 6 + 4 * np.sqrt(scores.frames[seen] / 30)
        label = f"{scores.kind}, against {scores.rows[scores.best][0]}"
        names.add(scores.rows[rows[0]][0])
        axes.scatter(
            scores.smoothness[seen], gain[seen], size, color=colour, alpha=0.7, label=label
        )
        for place in np.flatnonzero(seen) if is_named else ():
            point = (scores.smoothness[place], gain[place])
            away = {"xytext": (5, 4), "textcoords": "offset points", "fontsize": 8}
            axes.annotate(scores.subjects[place], point, **away)
    axes.axhline(0, color="black", lw=0.8)
    axes.margins(x=0.12)
    axes.grid(alpha=0.3)
    axes.set_title(f"{', '.join(sorted(names))}: each person, frames 3–5 ahead of whole tracks")
    axes.set_xlabel("smoothness: correlation of a step of the mouth with the next")
    axes.set_ylabel("error against the best baseline, %\n(below 0: better)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16))
    _save_png(figure, path)
    return [path]


def draw_forecast(
    path: Path, title: str, first_frame: int, truth: Forecast, forecast: Forecast
) -> None:
    """A column for each frame; truth, truth with landmarks, forecast, forecast with landmarks.

    Both have one sequence with images; ``first_frame`` is the number of the first forecast frame.
    """
    count = truth.landmarks.shape[1]
    # squares of known size: a layout that looks for the best takes seconds for twenty of them
    width, height = _LEFT + _STEP * count + _EDGE, _TOP + _STEP * 4 + _EDGE
    figure = new_matplotlib_figure(width, height, layout=None)
    figure.suptitle(title, y=1 - 0.1 / height, va="top", parse_math=False)
    grid = figure.subplots(4, count, squeeze=False)
    # left, bottom, right, top
    edges = (_LEFT / width, _EDGE / height, 1 - _EDGE / width, 1 - _TOP / height)
    figure.subplots_adjust(*edges, wspace=_GAP, hspace=_GAP)
    for number, line in enumerate(grid):
        label, item = ("truth", truth) if number < 2 else ("forecast", forecast)
        has_landmarks = number % 2 == 1
        assert item.images is not None
        for column, axes in enumerate(line):
            axes.imshow(item.images[0, column], extent=(0, 1, 1, 0), interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            if has_landmarks:
                _draw_landmarks(axes, item.landmarks[0, column])
            axes.set(xlim=(0, 1), ylim=(1, 0))
        line[0].set_ylabel(f"{label}, landmarks" if has_landmarks else label)
    for frame, axes in enumerate(grid[0], start=first_frame):
        axes.set_title(f"frame {frame}")
    _save_png(figure, path)


def _draw_curves(
    summaries: Sequence[KindSummary],
    key: str,
    x: NDArray[np.number],
    *,
    is_coverage: bool = False,
) -> tuple[Any, Sequence[Any]]:
    """A figure with a panel for each kind: curves of the numbers ``key``, with their intervals.

    Networks are in colour, baselines grey, the best of them black. Coverage is in percent, of rows
    with intervals only, and all of these have bands.
    """
    legend_room, factor = (1.1, 100.0) if is_coverage else (1.0, 1.0)
    figure = new_matplotlib_figure(_PANEL[0] * len(summaries), _PANEL[1] + legend_room)
    panels = figure.subplots(1, len(summaries), squeeze=False)[0]
    handles: dict[str, Any] = {}
    for axes, summary in zip(panels, summaries, strict=True):
        people = "person" if summary.subjects == 1 else "people"
        title = f"{summary.kind}: {summary.sequences} sequences, {summary.subjects} {people}"
        axes.set_title(title, fontsize="medium", parse_math=False)
        axes.grid(alpha=0.3)
        number = summary.numbers[key]
        networks = others = 0
        for i, row in enumerate(summary.rows):
            if row.role == "network":
                colour = COLOURS[networks % len(COLOURS)]
                style = {"color": colour, "lw": 2.2, "marker": "o", "ms": 4, "zorder": 3}
                networks += 1
            else:
                colour = "black" if row.name == summary.best_baseline else GREY
                mark = MARKS[others % len(MARKS)]
                style = {"color": colour, "lw": 1.2, "ls": "--", "marker": mark, "ms": 5}
                others += 1
            if is_coverage and not row.has_intervals:
                continue
            value, low, high = (factor * v[i] for v in (number.value, number.low, number.high))
            (line,) = axes.plot(x, value, **style)
            handles.setdefault(row.name, line)
            if is_coverage or row.role == "network" or row.name == summary.best_baseline:
                axes.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
    columns = min(4, 2 * len(summaries))  # more would be wider than one panel
    place = {"loc": "outside lower center", "ncols": columns, "fontsize": "small"}
    figure.legend(handles.values(), handles, **place)
    return figure, panels


def _draw_landmarks(axes: Any, landmarks: NDArray[np.floating]) -> None:
    if not np.isfinite(landmarks).all():
        box = {"facecolor": "black", "alpha": 0.6}
        axes.text(0.5, 0.5, "no face found", ha="center", va="center", color="white", bbox=box)
        return
    is_mouth = np.zeros(len(landmarks), dtype=bool)
    is_mouth[list(LIPS)] = True
    for part, colour, size in ((~is_mouth, OTHER_COLOUR, 1.6), (is_mouth, MOUTH_COLOUR, 4.5)):
        axes.scatter(*landmarks[part].T, s=size, c=colour, linewidths=0)


def _lively_sequence(scores: EvaluationScores, kind: str) -> int:
    """Place of a sequence that moves more than most of its kind: in most little happens."""
    places = scores.selection.of_kind(kind)
    last = mouth_distances(scores.row(PERSISTENCE).residuals[places])[:, -1]
    return int(places[np.argsort(last, kind="stable")[int(_LIVELIER_THAN * (len(last) - 1))]])


def _save_png(figure: Any, path: Path) -> None:
    with atomic_file(path) as temporary:
        # without the name of the program: it would change with matplotlib's version
        figure.savefig(temporary, format="png", metadata={"Software": None})
