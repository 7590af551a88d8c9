"""Success against the horizon, and against delay and horizon."""

from __future__ import annotations

from typing import Any

import numpy as np

from robo_manip_baselines.evaluation.figures import BLUE, GREY, INK, ORANGE, Plot, new_figure
from robo_manip_baselines.evaluation.paper_results import PAPER
from robo_manip_baselines.evaluation.statistics.arms import (
    BASELINE,
    CURRENT,
    PAPER_ERROR,
    PREDICTION,
)
from robo_manip_baselines.evaluation.statistics.study import ArmFigures, Study


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
