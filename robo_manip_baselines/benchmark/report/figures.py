"""Figures of a benchmark as SVG: the same bytes for the same statistics.

Matplotlib is imported where something is drawn.
"""

from __future__ import annotations

import importlib
import io
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.analysis import (
    BenchmarkStatistics,
    ConditionStatistics,
)
from robo_manip_baselines.benchmark.statistics.conditions import (
    BASELINE,
    CURRENT,
    PREDICTION,
    WITH_ERROR,
)
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel
from robo_manip_baselines.envs.mujoco.face.mesh import face_oval
from robo_manip_baselines.envs.mujoco.tasks.registry import EpisodeFigure
from robo_manip_baselines.envs.mujoco.tasks.safety import FORCE_TIERS, EpisodeSafety
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.files import write_text

INK = "#1f2328"
"""Color of axes and text; a page may put its own in its place."""

BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"
SKY, PINK, YELLOW, GREY = "#56b4e9", "#cc79a7", "#f0e442", "#8c8c8c"
"""Colors that color-blind readers can tell apart (Okabe and Ito)."""

FAILURE_COLORS = (GREY, PINK, BLUE, SKY, RED, ORANGE, YELLOW)
"""Colors of the kinds of failure in their order; further kinds are hatched."""

LEAD_COLORS = (BLUE, ORANGE, GREEN, PINK, SKY, RED, INK)
LEAD_MARKERS = "osD^"
"""Colors and markers of the curves over net lead."""

TIER_COLORS = (SKY, YELLOW, ORANGE, RED, INK)
"""Colors of forces up to each tier, and above the last."""

MANY_POINTS = 3000
"""More points are drawn as pixels: as shapes they would make the file large."""

HORIZON_LABEL = "horizon, frames of 1/30 s"

_INK_OF = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
STYLE: Any = {
    **dict.fromkeys(_INK_OF, INK),
    "axes.facecolor": "none",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 10.0,
    "grid.alpha": 0.3,
    "grid.color": GREY,
    "legend.facecolor": "none",
    "legend.framealpha": 0.0,
    "svg.fonttype": "none",
    "text.parse_math": False,  # a "$" in a condition's title is one
}
"""Matplotlib's settings for the figures of reports."""


@dataclass(frozen=True)
class ReportFigure:
    """Figure of a report.

    Attributes:
        name: of its file, without extension.
        title: above it.
        caption: below it.
        summary: for readers who cannot see it.
        svg: a whole SVG document.
    """

    name: str
    title: str
    caption: str
    summary: str
    svg: str

    @property
    def inline(self) -> str:
        """SVG element of a page, with identifiers of its own, in the color of the page's text."""
        svg = self.svg[self.svg.index("<svg") :]
        svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)

        def own(tag: re.Match[str]) -> str:  # tags only: text stays as it is
            text = tag[0].replace(INK, "currentColor")
            text = re.sub(r'\bid="', f'id="{self.name}-', text)
            text = text.replace('href="#', f'href="#{self.name}-')
            return text.replace("url(#", f"url(#{self.name}-")

        svg = re.sub(r"<[^>]*>", own, svg)
        label = f'role="img" aria-labelledby="{self.name}-title {self.name}-summary"'
        return svg.replace("<svg", f"<svg {label}", 1)


Draw = Callable[[Any, BenchmarkStatistics], tuple[str, str]]
"""Draws statistics into an empty Matplotlib figure; returns caption and summary."""


@contextmanager
def styled_figure(
    backend: str, background: str, style: Mapping[str, str] | None = None
) -> Iterator[Any]:
    """Yield an empty Matplotlib figure in the style of reports, to be drawn and saved in the block.

    Args:
        backend: of Matplotlib: ``agg`` or ``svg``.
        background: color.
        style: further settings of Matplotlib.

    Raises:
        RequestError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure

        canvas = importlib.import_module(f"matplotlib.backends.backend_{backend}").FigureCanvas
    except ImportError as error:
        raise RequestError(
            f"figures need matplotlib ({error}); run: {install_command('train')}"
        ) from None
    with mpl.rc_context(STYLE | dict(style or {})):
        figure = Figure(layout="constrained", facecolor=background)
        canvas(figure)
        yield figure


def render_figure(
    name: str, title: str, draw: Draw, statistics: BenchmarkStatistics
) -> ReportFigure:
    """Draw a figure in the style of the report.

    Args:
        name: of the figure; identifiers in the SVG are made from it.
        title: above it.
        draw: draws it.
        statistics: that it shows.

    Raises:
        RequestError: matplotlib is not installed.
    """
    stream = io.StringIO()
    with styled_figure("svg", "none", {"svg.hashsalt": name}) as figure:
        caption, summary = draw(figure, statistics)
        figure.savefig(stream, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    return ReportFigure(name, title, caption, summary, stream.getvalue())


def benchmark_figures(statistics: BenchmarkStatistics) -> tuple[ReportFigure, ...]:
    """Draw all figures for which there are conditions.

    Raises:
        RequestError: matplotlib is not installed.
    """
    success = statistics.end_point.capitalize()
    first = "success_by_horizon", f"{success} against the horizon", draw_success_by_horizon
    series = {(group, error) for group, error, *_ in HORIZON_SERIES}
    if not any((c.condition.group, c.condition.error) in series for c in statistics.conditions):
        first = "success_by_condition", f"{success} by condition", draw_success_by_condition
    figures: list[tuple[str, str, Draw]] = [
        first,
        ("completion_times", "Completion times", draw_completion_times),
        *((f.name, f.title, draw_episodes(f)) for f in statistics.study.figures),
        ("failures", "How episodes ended", draw_failures),
    ]
    if all(c.safety for c in statistics.conditions):
        figures.append(("touches", "Where and how hard the face was touched", draw_touches))
    if any(c.condition.delay for c in statistics.conditions):
        title = f"{success} against delay and horizon"
        figures.append(("delay_and_horizon", title, draw_delay_and_horizon))
    if _shows_net_lead(series := lead_series(statistics)):
        title = f"{success} against net lead"
        figures.append(("net_lead", title, partial(draw_net_lead, series=series)))
    return tuple(render_figure(*figure, statistics) for figure in figures)


def write_figures(folder: Path, figures: Sequence[ReportFigure]) -> list[Path]:
    """Write every figure as an SVG on white; return the paths."""
    paths = [folder / f"{figure.name}.svg" for figure in figures]
    for path, figure in zip(paths, figures, strict=True):
        # Ink is dark: it would not be visible on a dark page.
        start = figure.svg.index(">", figure.svg.index("<svg")) + 1
        background = '<rect width="100%" height="100%" fill="#ffffff"/>'
        write_text(path, figure.svg[:start] + background + figure.svg[start:])
    return paths


HORIZON_SERIES = (
    (BASELINE, "none", GREY, "", 0.12),
    (CURRENT, "none", INK, "", 0.12),
    (PREDICTION, "none", BLUE, "without error", -0.06),
    (PREDICTION, WITH_ERROR, ORANGE, "with error", 0.06),
)
"""Group and error of the conditions against the horizon; colour, label, and shift of markers."""


def draw_success_by_condition(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
    """Draw the rate of success, one row for each condition."""
    conditions = statistics.conditions
    figure.set_size_inches(8.0, 0.9 + 0.34 * len(conditions))
    axes = figure.add_subplot()
    for row, c in enumerate(conditions):
        found = statistics.rate(c)
        if found.rate is None or found.low is None or found.high is None:
            continue
        axes.plot([100.0 * found.low, 100.0 * found.high], [row, row], color=INK, lw=2)
        axes.plot(100.0 * found.rate, row, "o", color=INK, ms=5)
    _label_rows(axes, conditions)
    axes.set(xlabel=f"{statistics.end_point}, %", xlim=(-2.0, 102.0))
    axes.grid(axis="x")
    best = max(conditions, key=lambda c: statistics.rate(c).rate or 0.0)
    highest = f"“{best.condition.label}”, {statistics.rate(best)}"
    return _bars_caption(statistics), f"The highest rate is that of {highest}."


def _bars_caption(statistics: BenchmarkStatistics) -> str:
    """Say what the bars of rates are."""
    many = statistics.has_many_train_seeds
    seeds = " over training and evaluation seeds" if many else " (Wilson)"
    return f"Bands and bars: 95 % intervals{seeds}."


def draw_success_by_horizon(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
    """Draw success against the horizon, with and without error, and published results."""
    figure.set_size_inches(8.0, 4.6)
    axes, last = figure.add_subplot(), 0
    conditions, study = statistics.conditions, statistics.study
    for group, error, color, label, shift in HORIZON_SERIES:
        series = (group, error)
        own = [c for c in conditions if (c.condition.group, c.condition.error) == series]
        if not own:
            continue
        x = np.array([-1 if (h := c.condition.horizon) is None else h for c in own])
        rates = [(r.rate, r.low, r.high) for r in map(statistics.rate, own)]
        rate, low, high = 100.0 * np.array(rates, dtype=np.float64).T
        style: Any = {"color": color, "label": f"prediction {label}" if label else None}
        if len(x) > 1:
            axes.fill_between(x, low, high, color=color, alpha=0.18, lw=0)
            axes.plot(x, rate, "o-", **style)
        else:  # a band of one horizon has no width
            place = x + shift / 2 if label else x
            errors = np.maximum([rate - low, high - rate], 0.0)  # not -1e-17
            axes.errorbar(place, rate, errors, fmt="o", capsize=4, **style)
        there = [(h, c.published.successes) for h, c in zip(x, own, strict=True) if c.published]
        if there and statistics.measure == "success":  # the paper's
            places, successes = np.array(there, dtype=np.float64).T
            style = {"mfc": "none", "mec": color, "ms": 6, "ls": "none", "marker": "D"}
            style["label"] = f"paper, {label}" if label else None
            axes.plot(places + shift, 100.0 * successes / study.trials, **style)
        last = max(last, *x)
    ticks = range(-1, last + 1)
    current = "current" if last < 10 else "\ncurrent"  # below its neighbour
    axes.set_xticks(ticks, ["baseline", current, *map(str, ticks[2:])])
    ylabel = f"{statistics.end_point}, %"
    axes.set(xlabel=HORIZON_LABEL, ylabel=ylabel, xlim=(-1.4, last + 0.4), ylim=(0.0, 100.0))
    axes.grid(axis="y")
    if axes.get_legend_handles_labels()[1]:
        figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    caption = _bars_caption(statistics)
    if _has_published(statistics) and statistics.measure == "success":
        caption += f" Hollow markers: {_paper(study.success_table)}, {study.trials} episodes each."
    best = max(conditions, key=lambda c: statistics.rate(c).rate or 0.0)
    highest = f"“{best.condition.label}”, {statistics.rate(best)}"
    return caption, f"The highest rate is that of {highest}."


def draw_completion_times(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
    """Draw the completion times of successes, one row for each condition."""
    conditions = statistics.conditions
    figure.set_size_inches(8.0, 0.9 + 0.34 * len(conditions))
    axes = figure.add_subplot()
    rng = np.random.default_rng(0)  # scatters points up and down, so that they can be told apart
    many = sum(c.time.n for c in conditions) > MANY_POINTS
    for row, c in enumerate(conditions):
        times = c.outcomes.time[np.isfinite(c.outcomes.time)]
        dots: Any = {"color": SKY, "alpha": 0.55, "ms": 4, "mew": 0, "zorder": 1}
        places = row + rng.uniform(-0.25, 0.25, times.size)
        axes.plot(times, places, ".", rasterized=many, **dots)
        if c.time.low is not None:
            axes.plot([c.time.low, c.time.high], [row, row], color=INK, lw=2, zorder=3)
        if c.time.mean is not None:
            axes.plot(c.time.mean, row, "o", color=INK, ms=5, zorder=3)
        if c.published:
            there = c.published.completion_time
            axes.plot(there, row, "D", mfc="none", mec=RED, ms=6, zorder=4)
    _label_rows(axes, conditions)
    axes.set_xlabel(f"{statistics.task.completion_time}, s")
    axes.grid(axis="x")
    caption = "Light dots: successful episodes. Dark: mean and 95 % interval (bootstrap)."
    if _has_published(statistics):
        caption += f" Hollow diamonds: {_paper(statistics.study.time_table)}."
    means = [(c.time.mean, c.condition.label) for c in conditions if c.time.mean is not None]
    if not means:
        return caption, "No episode succeeded."
    mean, label = min(means, key=lambda found: found[0])
    return caption, f"The shortest mean is that of {label}, {mean:.2f} s."


def draw_episodes(episode_figure: EpisodeFigure) -> Draw:
    """Return the function that draws a task's figure, one panel for each condition."""

    def draw(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
        conditions = statistics.conditions
        columns = min(4, len(conditions))
        rows = -(-len(conditions) // columns)
        figure.set_size_inches(2.2 * columns, 2.45 * rows + 0.3)
        many = sum(len(c.rows) for c in conditions) > MANY_POINTS
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
        for axes in panels[len(conditions) :]:
            axes.set_axis_off()
        for axes, c in zip(panels, conditions, strict=False):
            results = [row.result for row in c.rows]
            values = [{**r.columns, "is_success": r.is_success} for r in results]
            episode_figure.draw(axes, values, many)
            axes.set_title(in_two_lines(c.condition.label), fontsize=9)
        figure.supxlabel(episode_figure.xlabel, fontsize=10)
        figure.supylabel(episode_figure.ylabel, fontsize=10)
        return episode_figure.caption, episode_figure.summary

    return draw


def draw_failures(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
    """Draw the proportions of the kinds of failure, one bar for each condition."""
    conditions = statistics.conditions
    figure.set_size_inches(8.0, 1.3 + 0.34 * len(conditions))
    axes = figure.add_subplot()
    counts = [Counter(row.result.failure for row in c.rows) for c in conditions]
    left = np.zeros(len(conditions))
    for number, kind in enumerate(("", *statistics.task.failures), start=-1):
        percent = np.array([100.0 * count[kind] / count.total() for count in counts])
        color = FAILURE_COLORS[number % len(FAILURE_COLORS)] if kind else GREEN
        label = kind.replace("_", " ") or "success"
        bars: Any = {"left": left, "color": color, "height": 0.75, "label": label}
        hatch = "///" if number >= len(FAILURE_COLORS) else None
        axes.barh(range(len(conditions)), percent, hatch=hatch, **bars)
        left += percent
    _label_rows(axes, conditions)
    axes.set(xlim=(0.0, 100.0), xlabel="episodes, %")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    failures = sum(counts, Counter())
    del failures[""]
    summary = "No episode failed."
    if failures:
        ((kind, count),) = failures.most_common(1)
        summary = (
            "The most frequent failure of all conditions is "
            f"{kind.replace('_', ' ')}, {count} episodes."
        )
    return "Kinds of failure as defined in the table.", summary


def draw_touches(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
    """Draw the face from the front with its contact points, one panel for each condition."""
    conditions = statistics.conditions
    draw_faces(
        figure,
        {
            c.condition.label: [row.result.safety for row in c.rows if row.result.safety]
            for c in conditions
        },
    )
    caption = (
        "For each episode, region and body that touched it, the point at which the force was "
        "largest; in the corner the episodes with a contact, food on lips and in the mouth apart."
    )
    force, label = max((c.safety.force_max, c.condition.label) for c in conditions if c.safety)
    if force == 0.0:
        return caption, "Nothing but food touched a face."
    return caption, f"The largest force, {force:.1f} N, is that of {label}."


def draw_faces(figure: Any, panels: Mapping[str, Sequence[EpisodeSafety]]) -> None:
    """Draw the face from the front with the contact points of episodes, given label -> episodes."""
    face = FaceModel.load()
    surface = 1000.0 * face.deform(face.jaw_angle(REST_OPENING))[:, 1:]
    names = ("eye_left", "eye_right", "lips_outer", "lips_inner")
    rings = [face_oval(face), *(face.rings[name] for name in names)]
    lines = [surface[np.append(ring, ring[0])] for ring in rings]
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    figure.set_size_inches(max(2.2 * columns, 4.4), 2.75 * rows + 0.7)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, (label, episodes) in zip(grid, panels.items(), strict=False):
        for line in lines:
            axes.plot(*line.T, color=GREY, lw=0.8, zorder=1)
        _draw_contact_points(axes, episodes)
        touched = sum(own.force > 0.0 for own in episodes)
        largest = max((own.force for own in episodes), default=0.0)
        text = f"{touched} of {len(episodes)} episodes\nlargest {largest:.1f} N"
        axes.text(0.02, 0.01, text, transform=axes.transAxes, fontsize=7, va="bottom")
        axes.set_title(in_two_lines(label), fontsize=9)
        axes.set(xlim=(-100.0, 100.0), ylim=(-135.0, 95.0), aspect="equal")
    figure.supxlabel("across the face, mm (right: the person's left)", fontsize=10)
    figure.supylabel("up, mm", fontsize=10)
    labels = [f"up to {tier} N" for tier in FORCE_TIERS] + [f"above {FORCE_TIERS[-1]} N"]
    marks = [
        grid[0].plot([], [], "o", color=color, ms=5, label=name)[0]
        for color, name in zip(TIER_COLORS, labels, strict=True)
    ]
    marks += grid[0].plot(
        [], [], "o", mfc="none", mec=GREY, ms=5, label="food on lips, in the mouth"
    )
    figure.legend(handles=marks, loc="outside upper center", ncols=3, fontsize=8)


def _draw_contact_points(axes: Any, episodes: Sequence[EpisodeSafety]) -> None:
    """Draw the contacts of episodes into the axes of a face, the hardest on top."""
    touched = sorted((t for own in episodes for t in own.touched), key=lambda t: t.force)
    many = len(touched) > MANY_POINTS
    for is_food in (True, False):
        own = [t for t in touched if t.is_food is is_food]
        tiers = np.searchsorted(FORCE_TIERS, [t.force for t in own])
        for tier, color in enumerate(TIER_COLORS):
            points = 1000.0 * np.array([t.point[1:] for t in own]).reshape(-1, 2)[tiers == tier]
            style: Any = {"mfc": "none", "mec": color} if is_food else {"color": color, "mew": 0}
            axes.plot(*points.T, "o", ms=3.5, alpha=0.75, zorder=2, rasterized=many, **style)


def draw_delay_and_horizon(figure: Any, statistics: BenchmarkStatistics) -> tuple[str, str]:
    """Draw success over delay and horizon as a heat map with numbers.

    Only conditions without error, or, if none of those is delayed, with the first error that is.
    """
    errors = {c.condition.error for c in statistics.conditions if c.condition.delay}
    error = min(errors, key=lambda error: (error != "none", error))
    rates = {
        (c.condition.delay, c.condition.horizon): 100.0 * (statistics.rate(c).rate or 0.0)
        for c in statistics.conditions
        if c.condition.error == error and c.condition.horizon is not None
    }
    delays, horizons = (sorted({key[place] for key in rates}) for place in (0, 1))
    grid = np.array([[rates.get((d, h), np.nan) for h in horizons] for d in delays])
    figure.set_size_inches(1.6 + 0.9 * len(horizons), 1.2 + 0.6 * len(delays))
    axes = figure.add_subplot()
    colors: Any = {"cmap": "cividis", "vmin": 0.0, "vmax": 100.0}
    image = axes.imshow(grid, origin="lower", aspect="auto", **colors)
    for (row, column), rate in np.ndenumerate(grid):
        if np.isfinite(rate):
            color = "#000000" if rate > 50.0 else "#ffffff"
            axes.text(column, row, f"{rate:.0f}", ha="center", va="center", color=color)
    axes.set_xticks(range(len(horizons)), [str(h) if h else "current" for h in horizons])
    axes.set_yticks(range(len(delays)), map(str, delays))
    axes.set(xlabel=HORIZON_LABEL, ylabel="delay, frames")
    figure.colorbar(image, ax=axes, label=f"{statistics.end_point}, %")
    caption = "Empty where no such condition was evaluated."
    if error != "none":
        caption += f" Conditions with {error} error."
    delay, horizon = min(rates, key=lambda key: (rates[key], key))
    return (
        caption,
        f"The lowest rate, {rates[delay, horizon]:.0f} %, is at a delay of {delay} frames and a "
        f"horizon of {horizon}.",
    )


@dataclass(frozen=True)
class LeadSeries:
    """Curve of the end point against net lead: conditions that differ in it alone.

    Attributes:
        policy: name.
        motion: of the face.
        delay: frames by which the observed target is late.
        points: net lead, frames, -> condition.
    """

    policy: str
    motion: str
    delay: int
    points: dict[int, ConditionStatistics]


def lead_series(statistics: BenchmarkStatistics) -> list[LeadSeries]:
    """Group the conditions that observe the true present or future by policy, motion and delay.

    Net lead is the horizon minus the delay, in frames: how far ahead of the present, or behind it,
    the latest target lies that a policy observes. Of several conditions in one place, as with
    another expert, the first counts.
    """
    found: dict[tuple[str, str, int], LeadSeries] = {}
    for c in statistics.conditions:
        result = c.rows[0].result
        horizon, delay, error = c.condition.horizon, c.condition.delay, c.condition.error
        if result.observation:  # a condition of another name than its spec's has one, too
            spec = ObservationSpec.from_json(result.observation)
            is_plain = not replace(spec.corruption, delay=0)
            horizon = spec.frames - 1 if spec.frames and is_plain and not spec.past_frames else None
            delay, error = spec.corruption.delay, spec.corruption.error
        if horizon is None or error != "none":
            continue
        key = result.policy, result.motion, delay
        found.setdefault(key, LeadSeries(*key, {})).points.setdefault(horizon - delay, c)
    return [found[key] for key in sorted(found)]


def _shows_net_lead(series: Sequence[LeadSeries]) -> bool:
    """Return whether there are three net leads or more, and something else than the horizon."""
    leads = {lead for own in series for lead in own.points}
    return len(leads) > 2 and any(own.delay or own.motion != "recorded" for own in series)


def draw_net_lead(
    figure: Any, statistics: BenchmarkStatistics, series: Sequence[LeadSeries]
) -> tuple[str, str]:
    """Draw the end point against net lead: a panel for each motion, a curve for each delay."""
    policies, delays = {s.policy for s in series}, sorted({s.delay for s in series})
    panels: dict[str, list[LeadSeries]] = {}
    for own in series:
        title = f"{own.policy}, {own.motion}" if len(policies) > 1 else own.motion
        panels.setdefault(title, []).append(own)
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure.set_size_inches(max(8.0, 3.6 * columns), 1.0 + 3.6 * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    curves: dict[int, Any] = {}
    best: tuple[float, int, str] | None = None
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, shown) in zip(grid.flat, panels.items(), strict=False):
        axes.set_title(title)
        axes.axvline(0.0, color=GREY, lw=1.0, ls=":")
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(axis="y")
        for own in shown:
            number = delays.index(own.delay)
            leads = sorted(own.points)
            rates = [statistics.rate(own.points[lead]) for lead in leads]
            rate, low, high = (
                100.0 * np.array([(r.rate, r.low, r.high) for r in rates], dtype=np.float64).T
            )
            style: Any = {"color": LEAD_COLORS[number % len(LEAD_COLORS)], "capsize": 3}
            style["fmt"] = f"{LEAD_MARKERS[number % len(LEAD_MARKERS)]}-"
            errors = np.maximum([rate - low, high - rate], 0.0)  # not -1e-17
            shift = 0.06 * (number - (len(delays) - 1) / 2)  # bars beside one another
            curves[own.delay] = axes.errorbar(np.array(leads) + shift, rate, errors, **style)
            label = f"{title}, {own.delay} frames late"
            top = (*max(zip(rate.tolist(), leads, strict=True)), label)
            best = max(best, top) if best else top
    grid[0, 0].set_ylim(0.0, 100.0)
    figure.supxlabel("net lead (horizon − delay), frames of 1/30 s", fontsize=10)
    figure.supylabel(f"{statistics.end_point}, %", fontsize=10)
    names = [f"{delay} frames late" for delay in delays]
    handles = [curves[delay] for delay in delays]
    figure.legend(handles, names, loc="outside upper center", ncols=4, fontsize=9)
    caption = (
        "The latest target that a policy observes, ahead of the present (right) or behind it: its "
        "latency budget is the delay, and the lag of the arm and the age of the plan come on top. "
        "Conditions that observe the true present or future; bars: 95 % intervals."
    )
    if best is None:
        return caption, "No condition observes a true target."
    return caption, f"The highest rate, {best[0]:.0f} %, is at a net lead of {best[1]}: {best[2]}."


def _has_published(statistics: BenchmarkStatistics) -> bool:
    return any(c.published for c in statistics.conditions)


def _paper(table: str) -> str:
    return f"the paper's {table or 'results'}"


def _label_rows(axes: Any, conditions: Sequence[ConditionStatistics]) -> None:
    """Label the rows of a figure with conditions, the first one on top."""
    axes.set_yticks(range(len(conditions)), [c.condition.label for c in conditions])
    axes.set_ylim(len(conditions) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def in_two_lines(label: str) -> str:
    """Break a long label at the comma nearest to its middle."""
    commas = [match.start() for match in re.finditer(", ", label)]
    if not commas or len(label) <= 18:
        return label
    middle = min(commas, key=lambda comma: abs(2 * comma - len(label)))
    return f"{label[:middle]}\n{label[middle + 2 :]}"
