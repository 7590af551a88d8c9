"""Grid of cells of each preset.

The full factorial is out of reach of two cores, so leads lie where something happens: none, and
three frames apart about the lead that latency explains, delay + lag of the arm + age of the plan.
Forecasters other than the truth are asked for that lead alone. Persistence is no cell of its own:
it is the truth with a lead of 0, episode for episode.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from robo_manip_baselines.benchmark.foresight.episodes import Cell, plan_age
from robo_manip_baselines.envs.mujoco.expert.servo import ARM_LAG
from robo_manip_baselines.envs.mujoco.face.forecasters import MAX_LEAD

STEP = 3
"""Frames between the leads beside the expected one."""


@dataclass(frozen=True)
class ForesightPreset:
    """Size of the study.

    Attributes:
        cells: of the grid.
        num_episodes: seeds of each cell.
    """

    cells: tuple[Cell, ...]
    num_episodes: int


def expected_lead(delay: int, execution: str) -> int:
    """Return the lead, in whole frames, that latency explains."""
    return delay + ARM_LAG + (0 if execution == "direct" else round(plan_age()))


def lead_cells(motion: str, delays: Iterable[int], execution: str = "direct") -> Iterator[Cell]:
    """Return cells of the true future, with leads about the expected one."""
    for delay in delays:
        expected = expected_lead(delay, execution)
        leads = {0, expected - STEP, expected, expected + STEP}
        yield from (
            Cell(motion, delay, execution, "truth", lead)
            for lead in sorted(leads)
            if 0 <= lead <= MAX_LEAD
        )


def forecaster_cells(
    motion: str, delays: Iterable[int], forecasters: Sequence[str], execution: str = "direct"
) -> Iterator[Cell]:
    """Return cells of other forecasters, with the expected lead."""
    for delay in delays:
        for name in forecasters:
            yield Cell(motion, delay, execution, name, expected_lead(delay, execution))


FITTED = ("constant_velocity", "autoregression", "kalman", "shuffled", "residual")
"""Forecasters other than the truth."""

SOME = ("constant_velocity", "autoregression", "residual")
"""Those that are tried at a further delay, or under a further motion."""


def _cpu() -> tuple[Cell, ...]:
    return (
        *lead_cells("dyskinetic", (0, 4, 8, 12)),
        *lead_cells("dyskinetic", (0, 4), "ensemble"),
        *forecaster_cells("dyskinetic", (4,), FITTED),
        *forecaster_cells("dyskinetic", (8,), SOME),
        *lead_cells("sway", (4, 8)),
        *forecaster_cells("sway", (4,), SOME),
        *lead_cells("recorded", (0, 4, 8)),
        *lead_cells("recorded", (4,), "ensemble"),
        *forecaster_cells("recorded", (4,), FITTED),
        *forecaster_cells("recorded", (0,), ("residual",)),
    )


def _full() -> tuple[Cell, ...]:
    moving = ("dyskinetic", "sway", "recorded", "recorded:speed=3")
    cells: list[Cell] = []
    for motion in (*moving, "still", "tremor"):
        is_control = motion not in moving
        cells += lead_cells(motion, (8,) if is_control else (0, 4, 8, 12))
        if not is_control:
            cells += lead_cells(motion, (0, 4, 8, 12), "ensemble")
            cells += forecaster_cells(motion, (0, 4, 8), FITTED)
            cells += forecaster_cells(motion, (4,), ("autoregression",), "ensemble")
    return tuple(cells)


def _smoke() -> tuple[Cell, ...]:
    return (
        *lead_cells("dyskinetic", (4,)),
        Cell("dyskinetic", 4, "ensemble", "truth", expected_lead(4, "ensemble")),
        *forecaster_cells("dyskinetic", (4,), ("autoregression", "shuffled")),
    )


PRESETS = {
    "cpu": ForesightPreset(_cpu(), 200),
    "full": ForesightPreset(_full(), 200),
    "smoke": ForesightPreset(_smoke(), 3),
}
"""Sizes by name."""
