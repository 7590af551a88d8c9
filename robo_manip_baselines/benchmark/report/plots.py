"""Success against the horizon, and against delay and horizon."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.report.figures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PINK,
    RED,
    SKY,
    YELLOW,
    Plot,
    new_figure,
)
from robo_manip_baselines.benchmark.statistics.conditions import (
    BASELINE,
    CURRENT,
    PAPER_ERROR,
    PREDICTION,
)
from robo_manip_baselines.benchmark.statistics.study import ArmFigures, Study
from robo_manip_baselines.envs.mujoco.tasks.feeding.failure import FAILURES, REACH
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE


def success_by_horizon(study: Study) -> Plot:
    """Draw success against the horizon, with and without error, and the paper's points."""
    name, title = "success_by_horizon", "Success against the horizon"
    with new_figure(name, 8.0, 4.6) as (figure, stream):
        axes = figure.add_subplot()
        horizons = [0, *_draw_presets(axes, study), *_draw_predictions(axes, study)]
        ticks = [-1, *range(max(horizons) + 1)]
        axes.set_xticks(ticks, ["baseline", "current", *map(str, ticks[2:])])
        axes.set(
            xlabel="horizon, frames of 1/30 s", ylabel="success, %", xlim=(-1.4, ticks[-1] + 0.4)
        )
        axes.set_ylim(0.0, 100.0)
        axes.grid(axis="y")
        if axes.get_legend_handles_labels()[1]:
            axes.legend(loc="lower right", ncols=2, fontsize=9)
    best = max(study.arms, key=lambda f: f.success.rate or 0.0)
    return Plot(
        name,
        title,
        "Bands and bars: 95 % intervals"
        + (" over training and evaluation seeds." if study.has_many_train_seeds else " (Wilson).")
        + " Hollow markers: the paper's Table IV, 50 episodes each.",
        f"The highest rate is that of “{best.arm.label}”, {best.success}.",
        stream.getvalue(),
    )


def delay_surface(study: Study) -> Plot | None:
    """Draw success over delay and horizon as a heat map with numbers.

    Only arms without error, or where none of those is late, with the first error that is. Nothing
    where no arm is late.
    """
    late = sorted({f.arm.error for f in study.arms if f.arm.delay}, key=lambda e: (e != "none", e))
    if not late:
        return None
    cells = {
        (f.arm.delay, f.arm.horizon): f
        for f in study.arms
        if f.arm.error == late[0] and f.arm.horizon is not None
    }
    delays, horizons = (sorted({key[place] for key in cells}) for place in (0, 1))
    rates = np.full((len(delays), len(horizons)), np.nan)
    for (delay, horizon), figures in cells.items():
        if figures.success.rate is not None:
            rates[delays.index(delay), horizons.index(horizon)] = 100.0 * figures.success.rate
    name, title = "delay_and_horizon", "Success against delay and horizon"
    size = 1.6 + 0.9 * len(horizons), 1.2 + 0.6 * len(delays)
    with new_figure(name, *size) as (figure, stream):
        axes = figure.add_subplot()
        image = axes.imshow(
            rates, cmap="cividis", vmin=0.0, vmax=100.0, origin="lower", aspect="auto"
        )
        for (row, column), rate in np.ndenumerate(rates):
            if np.isfinite(rate):
                colour = "#000000" if rate > 50.0 else "#ffffff"
                axes.text(column, row, f"{rate:.0f}", ha="center", va="center", color=colour)
        axes.set_xticks(range(len(horizons)), [str(h) if h else "current" for h in horizons])
        axes.set_yticks(range(len(delays)), map(str, delays))
        axes.set(xlabel="horizon, frames of 1/30 s", ylabel="delay, frames")
        figure.colorbar(image, ax=axes, label="success, %")
    worst = np.unravel_index(np.nanargmin(rates), rates.shape)
    return Plot(
        name,
        title,
        "Empty where no such arm was run."
        + ("" if late[0] == "none" else f" Arms with {late[0]} error."),
        f"The lowest rate, {rates[worst]:.0f} %, is at a delay of {delays[worst[0]]} frames and a "
        f"horizon of {horizons[worst[1]]}.",
        stream.getvalue(),
    )


def _rates(figures: ArmFigures) -> tuple[float, float, float]:
    """Return rate, low and high end in per cent."""
    found = figures.success
    rate, low, high = (100.0 * (x or 0.0) for x in (found.rate, found.low, found.high))
    return rate, low, high


def _draw_presets(axes: Any, study: Study) -> list[int]:
    """Draw baseline and current, which have a place each; return the places."""
    places = []
    for group, place, colour in ((BASELINE, -1, GREY), (CURRENT, 0, INK)):
        for figures in (f for f in study.arms if f.arm.group == group):
            rate, low, high = _rates(figures)
            ends = [[rate - low], [high - rate]]
            axes.errorbar(place, rate, ends, fmt="o", color=colour, capsize=4)
            if figures.arm.name in PAPER:
                there = 100.0 * PAPER[figures.arm.name].rate
                axes.plot(place + 0.12, there, "D", mfc="none", mec=colour, ms=6)
            places.append(place)
    return places


def _draw_predictions(axes: Any, study: Study) -> list[int]:
    """Draw what comes with a forecast; return the horizons."""
    horizons: list[int] = []
    for error, colour, label, shift in (
        ("none", BLUE, "without error", -0.06),
        (PAPER_ERROR, ORANGE, "with error", 0.06),
    ):
        arms = [f for f in study.arms if f.arm.group == PREDICTION and f.arm.error == error]
        if not arms:
            continue
        x = [f.arm.horizon or 0 for f in arms]
        rate, low, high = np.array([_rates(f) for f in arms]).T
        if len(x) > 1:
            axes.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
            axes.plot(x, rate, "o-", color=colour, label=f"prediction {label}")
        else:  # a band of one horizon has no width
            ends, place = [rate - low, high - rate], x[0] + shift / 2
            style = {"fmt": "o", "color": colour, "capsize": 4}
            axes.errorbar(place, rate, ends, label=f"prediction {label}", **style)
        named = [(h + shift, f.arm.name) for h, f in zip(x, arms, strict=True)]
        there = [(h, 100.0 * PAPER[name].rate) for h, name in named if name in PAPER]
        if there:
            style = {"mfc": "none", "mec": colour, "ms": 6, "ls": "none"}
            axes.plot(*zip(*there, strict=True), marker="D", label=f"paper, {label}", **style)
        horizons += x
    return horizons


FACE_VIEW = 0.06
"""m to every side of the mouth in the plot of arrivals."""

MANY_POINTS = 3000
"""More of them are drawn as pixels: as shapes they would make the file large."""

FAILURE_COLOURS = dict(zip(FAILURES, (GREY, PINK, BLUE, SKY, RED, ORANGE, YELLOW), strict=True))


def benchmark_plots(study: Study) -> tuple[Plot, ...]:
    """Draw all plots for which there are arms.

    Raises:
        RequestError: matplotlib is not installed.
    """
    drawn = (
        success_by_horizon(study),
        completion_times(study),
        arrivals(study),
        failure_kinds(study),
        delay_surface(study),
    )
    return tuple(plot for plot in drawn if plot)


def completion_times(study: Study) -> Plot:
    """Draw the times of successes, one row for each arm."""
    name, title = "completion_times", "Completion times"
    rng = np.random.default_rng(0)  # scatters points up and down, so that they can be told apart
    arms = study.arms
    many = sum(f.time.n for f in arms) > MANY_POINTS
    with new_figure(name, 8.0, 0.9 + 0.34 * len(arms)) as (figure, stream):
        axes = figure.add_subplot()
        for row, figures in enumerate(arms):
            times = figures.outcomes.time[np.isfinite(figures.outcomes.time)]
            jitter = row + rng.uniform(-0.25, 0.25, times.size)
            axes.plot(
                times, jitter, ".", color=SKY, alpha=0.55, ms=4, mew=0, zorder=1, rasterized=many
            )
            time = figures.time
            if time.low is not None and time.high is not None:
                axes.plot([time.low, time.high], [row, row], color=INK, lw=2, zorder=3)
            if time.mean is not None:
                axes.plot(time.mean, row, "o", color=INK, ms=5, zorder=3)
            if figures.arm.name in PAPER:
                there = PAPER[figures.arm.name].completion_time
                axes.plot(there, row, "D", mfc="none", mec=RED, ms=6, zorder=4)
        _name_rows(axes, arms)
        axes.set_xlabel("from the lift to success, s")
        axes.grid(axis="x")
    timed = [figures for figures in arms if figures.time.mean is not None]
    fastest = min(timed, key=lambda f: f.time.mean or 0.0, default=None)
    return Plot(
        name,
        title,
        "Light dots: successful episodes. Dark: mean and 95 % interval (bootstrap). "
        "Hollow diamonds: the paper's Table V.",
        f"The shortest mean is that of {fastest.arm.label}, {fastest.time.mean:.2f} s."
        if fastest
        else "No episode succeeded.",
        stream.getvalue(),
    )


def arrivals(study: Study) -> Plot:
    """Draw where on the mouth's plane the cube came nearest, one picture for each arm.

    The face is seen from in front: the person's left is on the right.
    """
    name, title = "arrivals", "Where on the face the cube arrived"
    columns = min(4, len(study.arms))
    rows = -(-len(study.arms) // columns)
    many = sum(len(f.lines) for f in study.arms) > MANY_POINTS
    across, up = 1000.0 * MOUTH_TOLERANCE[1:]
    view = 1000.0 * FACE_VIEW
    with new_figure(name, 2.2 * columns, 2.45 * rows + 0.3) as (figure, stream):
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(study.arms) :]:
            axes.set_axis_off()
        for axes, figures in zip(grid.flat, study.arms, strict=False):
            results = [line.result for line in figures.lines]
            at_face = [
                (1000.0 * r.cube_offset[1], 1000.0 * r.cube_offset[2], r.is_success)
                for r in results
                if r.cube_offset is not None and abs(r.cube_offset[0]) < REACH
            ]
            seen = [p for p in at_face if max(abs(p[0]), abs(p[1])) <= view]
            for is_success, colour, marker in ((False, RED, "x"), (True, GREEN, ".")):
                points = np.array([p[:2] for p in seen if p[2] == is_success]).reshape(-1, 2)
                axes.plot(
                    *points.T, marker, color=colour, ms=3.5, mew=0.7, alpha=0.7, rasterized=many
                )
            axes.plot(
                [-across, across, across, -across, -across],
                [-up, -up, up, up, -up],
                color=INK,
                lw=1.2,
            )
            axes.set_title(_two_lines(figures.arm.label), fontsize=9)
            missing = f"{len(results) - len(at_face)} not at the face"
            if outside := len(at_face) - len(seen):
                missing += f", {outside} outside"
            axes.text(0.02, 0.02, missing, transform=axes.transAxes, fontsize=7)
            axes.set(xlim=(-view, view), ylim=(-view, view), aspect="equal")
        figure.supxlabel("across the face, mm (right: the person's left)", fontsize=10)
        figure.supylabel("up, mm", fontsize=10)
    return Plot(
        name,
        title,
        "The centre of the cube on the mouth's plane where, held, it was nearest to the mouth, if "
        f"that was within {1000 * REACH:.0f} mm along the face's normal. Green dots: successes; "
        f"red crosses: failures; the box: ±{across:.0f} mm, the tolerance that Algorithm 1 gives "
        "to the gripper behind it.",
        "One scatter plot for each arm; the numbers are in the table of how episodes ended.",
        stream.getvalue(),
    )


def failure_kinds(study: Study) -> Plot:
    """Draw the share of every kind of failure, one bar for each arm."""
    name, title = "failures", "How episodes ended"
    kinds = {"": GREEN, **FAILURE_COLOURS}
    with new_figure(name, 8.0, 1.3 + 0.34 * len(study.arms)) as (figure, stream):
        axes = figure.add_subplot()
        left = np.zeros(len(study.arms))
        for kind, colour in kinds.items():
            shares = np.array(
                [
                    100.0 * Counter(line.result.failure for line in f.lines)[kind] / len(f.lines)
                    for f in study.arms
                ]
            )
            label = kind.replace("_", " ") or "success"
            rows = range(len(study.arms))
            axes.barh(rows, shares, left=left, color=colour, height=0.75, label=label)
            left += shares
        _name_rows(axes, study.arms)
        axes.set(xlim=(0.0, 100.0), xlabel="share of episodes, %")
        figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    counts = Counter(line.result.failure for f in study.arms for line in f.lines)
    del counts[""]
    most = counts.most_common(1)
    return Plot(
        name,
        title,
        "Kinds of failure as defined in the table.",
        f"The most frequent failure of all arms is {most[0][0].replace('_', ' ')}, "
        f"{most[0][1]} episodes."
        if most
        else "No episode failed.",
        stream.getvalue(),
    )


def _name_rows(axes: Any, arms: Sequence[ArmFigures]) -> None:
    """Name the rows of a plot after arms, the first one on top."""
    axes.set_yticks(range(len(arms)), [f.arm.label for f in arms])
    axes.set_ylim(len(arms) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def _two_lines(label: str) -> str:
    """Break a long label at its first comma."""
    head, comma, tail = label.partition(", ")
    return f"{head}\n{tail}" if comma and len(label) > 18 else label
