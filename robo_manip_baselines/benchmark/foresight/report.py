"""Tables, figures and page of a study of foresight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robo_manip_baselines.benchmark.foresight.analysis import (
    BestLead,
    CellStatistics,
    ForesightStatistics,
    Setting,
)
from robo_manip_baselines.benchmark.foresight.episodes import CHUNK_SIZE, EXECUTIONS, plan_age
from robo_manip_baselines.benchmark.foresight.forecasters import FORECASTERS
from robo_manip_baselines.benchmark.foresight.grid import expected_lead
from robo_manip_baselines.benchmark.report.figures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PINK,
    RED,
    SKY,
    styled_figure,
)
from robo_manip_baselines.benchmark.statistics.inference import Estimate
from robo_manip_baselines.benchmark.tables.table import (
    NOTHING,
    Cell,
    Column,
    Row,
    Table,
    to_markdown,
    write_tables,
)
from robo_manip_baselines.envs.mujoco.expert.servo import ARM_LAG
from robo_manip_baselines.envs.mujoco.face.forecasters import MAX_LEAD
from robo_manip_baselines.rollout.results import Proportion
from robo_manip_baselines.runs.files import atomic_file, write_text

PAGE = "README.md"
TABLES = "tables"
FIGURES = "figures"

EXECUTION_TITLES = {
    "direct": "direct",
    "ensemble": f"chunks of {CHUNK_SIZE}, ensemble",
}

FORECASTER_COLORS = dict(zip(FORECASTERS, (INK, GREY, ORANGE, BLUE, GREEN, PINK, RED), strict=True))


# -- tables ---------------------------------------------------------------------------------------


def study_tables(statistics: ForesightStatistics) -> list[Table]:
    """Return the tables: best leads, what explains them, and all cells."""
    return [_best_lead_table(statistics), _law_table(statistics), _cell_table(statistics)]


def _cell_table(statistics: ForesightStatistics) -> Table:
    columns = (
        *(_words(name) for name in ("motion", "delay", "execution", "forecaster", "lead")),
        Column("success, %", ("success", "success_low", "success_high")),
        Column("strict success, %", ("strict", "strict_low", "strict_high")),
        Column("force, N", ("force_90",)),
        Column("tracking error, mm", ("tracking_error_mm",)),
        Column("episodes", ("episodes",)),
    )
    rows = []
    for found in statistics.cells:
        error = None if found.tracking_error is None else 1e3 * found.tracking_error
        cells = (
            *(Cell(str(value), (value,)) for value in found.cell),
            _rate(found.success),
            _rate(found.strict),
            Cell(f"{found.force:.1f}", (found.force,)),
            Cell(NOTHING if error is None else f"{error:.1f}", (error,)),
            Cell(str(found.n), (found.n,)),
        )
        rows.append(Row(found.cell.motion, cells))
    notes = (
        "Delay and lead in frames of 1/30 s, the lead from the newest frame seen.",
        "95 % intervals by Wilson.",
        "Force: 90th percentile over episodes of the largest on the face.",
        "Tracking error: root mean square, across the approach, during the insertion.",
        "A lead of 0 is persistence.",
    )
    return Table("cells", "All cells", columns, tuple(rows), notes)


def _best_lead_table(statistics: ForesightStatistics) -> Table:
    columns = (
        *(_words(name) for name in ("motion", "delay", "execution")),
        Column("best lead", ("lead", "lead_low", "lead_high")),
        Column("expected", ("expected",)),
        Column("strict success, none to expected, points", ("gain", "gain_low", "gain_high")),
        Column("p", ("p",)),
        Column("episodes", ("episodes",)),
    )
    rows = []
    for best in statistics.best_leads:
        gain = Estimate(None, None, None, 0) if best.gain is None else best.gain.difference
        p = None if best.gain is None else best.gain.p
        cells = (
            *(Cell(str(value), (value,)) for value in best.setting),
            _number(best.lead),
            Cell(str(best.expected), (best.expected,)),
            _number(gain, 100.0, 0, "+"),
            Cell(NOTHING if p is None else f"{p:.2g}", (p,)),
            Cell(str(gain.n), (gain.n,)),
        )
        rows.append(Row(best.setting.motion, cells))
    notes = (
        "Best lead: vertex of the parabola through the mean square tracking errors at the three "
        "leads about the smallest, interval by bootstrap over seeds; none where the smallest is at "
        "an end of the leads.",
        f"Expected: delay + {ARM_LAG} frames of the arm's lag + {plan_age():.1f} frames, the mean "
        "age of the plans in the ensemble.",
        "Strict success with the true future at the expected lead minus that with a lead of 0, on "
        "common seeds, with the p-value of McNemar's test.",
    )
    return Table("best_leads", "Best lead and value of foresight", columns, tuple(rows), notes)


def _law_table(statistics: ForesightStatistics) -> Table:
    names = ("slope", "lag", "age")
    titles = ("slope", "lag of the arm, frames", "age of the ensemble, frames")
    columns = (
        _words("motion"),
        *(Column(t, (n, f"{n}_low", f"{n}_high")) for t, n in zip(titles, names, strict=True)),
        Column("settings", ("settings",)),
    )
    rows = [
        Row(
            law.motion or "all",
            (
                Cell(law.motion or "all", (law.motion or "all",)),
                *(_number(getattr(law, name), digits=2) for name in names),
                Cell(str(law.n), (law.n,)),
            ),
        )
        for law in statistics.laws
    ]
    notes = (
        "Least squares over the best leads of settings: lead = slope x delay + lag + age, the age "
        "for the ensemble alone; intervals by bootstrap over seeds.",
        f"Latency alone explains a slope of 1, a lag of {ARM_LAG} and an age of {plan_age():.1f}.",
    )
    return Table("latency", "What explains the best lead", columns, tuple(rows), notes)


def _words(name: str) -> Column:
    return Column(name, (name,), is_text=name not in ("delay", "lead"))


def _rate(found: Proportion) -> Cell:
    values = (found.rate, found.low, found.high)
    rate, low, high = (100.0 * (value or 0.0) for value in values)
    return Cell(f"{rate:.0f} ({low:.0f} … {high:.0f})", values)


def _number(found: Estimate, scale: float = 1.0, digits: int = 1, sign: str = "") -> Cell:
    values = (found.mean, found.low, found.high)
    if found.mean is None:
        return Cell(NOTHING, values)
    form = f"{sign}.{digits}f"
    text = format(scale * found.mean, form)
    if found.low is not None and found.high is not None:
        text += f" ({format(scale * found.low, form)} … {format(scale * found.high, form)})"
    return Cell(text, values)


# -- figures --------------------------------------------------------------------------------------


class StudyFigure(NamedTuple):
    """Figure of a study.

    Attributes:
        name: of its file, without extension.
        caption: below it.
        draw: draws statistics into an empty Matplotlib figure.
    """

    name: str
    caption: str
    draw: Callable[[Any, ForesightStatistics], None]


def _panels(
    figure: Any, statistics: ForesightStatistics, size: tuple[float, float], rows: Sequence[str]
) -> tuple[list[str], Any]:
    """Return the motions, and axes (rows, motions)."""
    motions = list(dict.fromkeys(found.cell.motion for found in statistics.cells))
    figure.set_size_inches(max(size[0] * len(motions), 6.4), size[1] * len(rows) + 0.8)
    return motions, figure.subplots(len(rows), len(motions), squeeze=False, sharey="row")


def _of(
    statistics: ForesightStatistics, motion: str, execution: str, forecaster: str = "truth"
) -> list[CellStatistics]:
    wanted = (motion, execution, forecaster)
    return [
        found
        for found in statistics.cells
        if (found.cell.motion, found.cell.execution, found.cell.forecaster) == wanted
    ]


def _executions(statistics: ForesightStatistics) -> list[str]:
    there = {found.cell.execution for found in statistics.cells}
    return [execution for execution in EXECUTIONS if execution in there]


def draw_surface(figure: Any, statistics: ForesightStatistics) -> None:
    """Draw strict success over delay and lead, with the best lead marked."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

    executions = _executions(statistics)
    motions, panels = _panels(figure, statistics, (4.2, 2.6), executions)
    best = {found.setting: found for found in statistics.best_leads}
    delays = sorted({found.cell.delay for found in statistics.cells})
    scale: Any = ScalarMappable(Normalize(0.0, 100.0), "cividis")
    for execution, line in zip(executions, panels, strict=True):
        for motion, axes in zip(motions, line, strict=True):
            cells = _of(statistics, motion, execution)
            if not cells:
                axes.set_axis_off()
                continue
            for found in cells:
                delay, lead = delays.index(found.cell.delay), found.cell.lead
                percent = 100.0 * (found.strict.rate or 0.0)
                place: Any = ((lead - 1.4, delay - 0.44), 2.8, 0.88)
                axes.add_patch(Rectangle(*place, color=scale.to_rgba(percent), lw=0))
                color = "#000000" if percent > 50.0 else "#ffffff"
                axes.text(lead, delay, f"{percent:.0f}", ha="center", va="center", color=color)
            for delay in delays:
                _mark_best(axes, best.get(Setting(motion, delay, execution)), delays.index(delay))
            axes.set_xlim(-2.0, MAX_LEAD + 2.0)
            axes.set_ylim(-0.6, len(delays) - 0.4)
            axes.set_xticks(range(0, MAX_LEAD + 1, 4))
            axes.set_yticks(range(len(delays)), map(str, delays))
            axes.set_title(f"{motion}, {EXECUTION_TITLES[execution]}", fontsize=10)
            axes.yaxis.set_tick_params(labelleft=True)
    figure.supxlabel("lead, frames of 1/30 s", fontsize=10)
    figure.supylabel("delay, frames", fontsize=10)
    figure.colorbar(scale, ax=panels, label="strict success, %", shrink=0.8)


def _mark_best(axes: Any, best: BestLead | None, row: int) -> None:
    if best is None:
        return
    axes.plot(best.expected, row - 0.32, "^", color="#ffffff", mec=INK, ms=8, zorder=5)
    if best.lead.mean is not None:
        axes.plot(best.lead.mean, row + 0.32, "v", color=RED, mec="#ffffff", ms=9, zorder=5)


def draw_tracking(figure: Any, statistics: ForesightStatistics) -> None:
    """Draw the tracking error against the lead, counted from the expected one."""
    from matplotlib.ticker import MaxNLocator

    executions = _executions(statistics)
    motions, panels = _panels(figure, statistics, (3.6, 2.6), executions)
    delays = sorted({found.cell.delay for found in statistics.cells})
    colors = dict(zip(delays, cycle((SKY, BLUE, GREEN, ORANGE)), strict=False))
    for execution, line in zip(executions, panels, strict=True):
        for motion, axes in zip(motions, line, strict=True):
            cells = _of(statistics, motion, execution)
            if not cells:
                axes.set_axis_off()
                continue
            for delay in sorted({found.cell.delay for found in cells}):
                expected = expected_lead(delay, execution)
                points = [
                    (found.cell.lead - expected, 1e3 * found.tracking_error)
                    for found in cells
                    if found.cell.delay == delay and found.tracking_error is not None
                ]
                x, y = zip(*points, strict=True) if points else ((), ())
                style: Any = {"color": colors[delay], "label": f"delay {delay}"}
                axes.plot(x, y, "o-", ms=5, **style)
            axes.axvline(0.0, color=GREY, lw=1.0, ls=":")
            axes.set_title(f"{motion}, {EXECUTION_TITLES[execution]}", fontsize=10)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.grid(axis="y")
            axes.legend(fontsize=8)
    for axes in panels[:, 0]:  # they share their limits with those of their row
        axes.set_ylim(bottom=0.0)
    figure.supxlabel("lead minus the expected lead, frames of 1/30 s", fontsize=10)
    figure.supylabel("tracking error, mm", fontsize=10)


def draw_forecasters(figure: Any, statistics: ForesightStatistics) -> None:
    """Draw strict success by forecaster, at the expected lead, against the delay."""
    motions, panels = _panels(figure, statistics, (3.6, 3.2), ["direct"])
    for motion, axes in zip(motions, panels[0], strict=True):
        names = [name for name in FORECASTERS if name != "persistence"]
        series = {name: _of(statistics, motion, "direct", name) for name in names}
        for name, cells in series.items():
            series[name] = [
                found
                for found in cells
                if found.cell.lead == expected_lead(found.cell.delay, "direct")
            ]
        truth = _of(statistics, motion, "direct")
        series["persistence"] = [found for found in truth if found.cell.lead == 0]
        shift = {name: 0.1 * (k - len(series) / 2.0) for k, name in enumerate(FORECASTERS)}
        for name in (name for name in FORECASTERS if series[name]):
            x = np.array([found.cell.delay for found in series[name]]) + shift[name]
            rates = [found.strict for found in series[name]]
            rate, low, high = 100.0 * np.array([(r.rate, r.low, r.high) for r in rates], float).T
            errors = np.maximum([rate - low, high - rate], 0.0)  # not -1e-17
            style: Any = {"color": FORECASTER_COLORS[name], "label": name.replace("_", " ")}
            axes.errorbar(x, rate, errors, fmt="o-", ms=5, capsize=3, **style)
        axes.set_title(motion, fontsize=10)
        axes.set_ylim(-2.0, 102.0)
        axes.set_xticks(sorted({found.cell.delay for found in truth}))
        axes.grid(axis="y")
    handles = dict[str, Any]()
    for axes in panels[0]:
        drawn, labels = axes.get_legend_handles_labels()
        handles.update(zip(labels, drawn, strict=True))
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=4, fontsize=9)
    figure.supxlabel("delay, frames of 1/30 s", fontsize=10)
    figure.supylabel("strict success, %", fontsize=10)


FIGURE_LIST = (
    StudyFigure(
        "surface",
        "Strict success, %, over delay and lead, with the true future. Red, from above: the "
        "best lead, by the tracking error. White, from below: the lead that latency explains.",
        draw_surface,
    ),
    StudyFigure(
        "tracking",
        "Tracking error against the lead, counted from the one that latency explains.",
        draw_tracking,
    ),
    StudyFigure(
        "forecasters",
        "Strict success by forecaster, each at the lead that latency explains; persistence is a "
        "lead of 0. Bars: 95 % intervals (Wilson).",
        draw_forecasters,
    ),
)


def write_figures(folder: Path, statistics: ForesightStatistics) -> None:
    """Write all figures as PNG.

    Raises:
        RequestError: matplotlib is not installed.
    """
    for item in FIGURE_LIST:
        with styled_figure("agg", "#ffffff") as figure:
            item.draw(figure, statistics)
            with atomic_file(folder / f"{item.name}.png") as temporary:
                figure.savefig(temporary, format="png", dpi=120, metadata={"Software": None})


# -- page -----------------------------------------------------------------------------------------


def write_report(out: Path, statistics: ForesightStatistics, facts: Mapping[str, str]) -> None:
    """Write tables, figures and the page that shows them.

    Args:
        out: folder of the study.
        statistics: of its rows.
        facts: at the top of the page, such as the command: name -> text.

    Raises:
        RequestError: matplotlib is not installed.
    """
    tables = study_tables(statistics)
    write_tables(out / TABLES, tables)
    write_figures(out / FIGURES, statistics)
    best, law, cells = map(to_markdown, tables)
    figures = [f"![{f.caption}]({FIGURES}/{f.name}.png)\n\n*{f.caption}*\n" for f in FIGURE_LIST]
    lines = [
        "# Value of foresight without a learner\n",
        "A scripted visual servo feeds people who move. It sees the mouth some frames late (delay) "
        "and aims where a forecast says that it will be some frames after the newest one seen "
        "(lead). What it reaches with the true future is an upper bound for policies.\n",
        *(f"- {name}: {text}" for name, text in facts.items()),
        "",
        *(figures[0], best, law, *figures[1:], cells),
    ]
    write_text(out / PAGE, "\n".join(lines))
