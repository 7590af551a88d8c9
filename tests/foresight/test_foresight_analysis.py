"""Best leads and what explains them, on rows whose truth is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from robo_manip_baselines.benchmark.foresight.analysis import (
    ForesightStatistics,
    Setting,
    vertex,
)
from robo_manip_baselines.benchmark.foresight.episodes import Cell, ForesightRow
from robo_manip_baselines.benchmark.foresight.grid import (
    PRESETS,
    expected_lead,
    forecaster_cells,
    lead_cells,
)
from robo_manip_baselines.benchmark.foresight.report import study_tables

CELLS = [*lead_cells("sway", (0, 4, 8)), *lead_cells("sway", (0, 4), "ensemble")]


def rows_of(
    best_lead: Callable[[Cell], float], seeds: int = 40, noise: float = 0.0
) -> list[ForesightRow]:
    """Rows whose mean square error is a parabola in the lead; strict success at 3 frames off."""
    rng = np.random.default_rng(0)
    rows = []
    for cell in CELLS:
        off = cell.lead - best_lead(cell)
        for seed in range(seeds):
            square = 1e-6 * (1.0 + 0.25 * off**2) * np.exp(noise * rng.normal())
            rows.append(
                ForesightRow(
                    **cell._asdict(),
                    seed=seed,
                    is_success=True,
                    is_success_strict=abs(off) < 4.0,
                    completion_time=3.0,
                    face_force=float(seed),
                    tracking_error=float(np.sqrt(square)),
                    steps=300,
                )
            )
    return rows


def law(cell: Cell) -> float:
    return 1.1 * cell.delay + 2.5 + (8.0 if cell.execution == "ensemble" else 0.0)


def test_the_vertex_of_a_parabola() -> None:
    leads = np.array([0, 4, 7])
    values = 2.0 + 0.3 * (leads - np.array([[3.2], [5.0]])) ** 2
    np.testing.assert_allclose(vertex(leads, values), [3.2, 5.0])


def test_best_leads_and_their_line_are_found() -> None:
    found = ForesightStatistics(rows_of(law), resamples=99)
    leads = {best.setting: best.lead.mean for best in found.best_leads}
    assert leads == {setting: pytest.approx(law(Cell(*setting, "truth", 0))) for setting in leads}
    assert len(leads) == 5
    whole, sway = found.laws
    assert (whole.motion, sway.motion, whole.n) == ("", "sway", 5)
    for estimate, true in ((whole.slope, 1.1), (whole.lag, 2.5), (whole.age, 8.0)):
        assert estimate.mean == pytest.approx(true)


def test_intervals_hold_the_truth_and_shrink_with_seeds() -> None:
    few, many = (
        ForesightStatistics(rows_of(law, seeds, noise=0.5), resamples=999).laws[0]
        for seeds in (20, 320)
    )
    for name, true in (("slope", 1.1), ("lag", 2.5), ("age", 8.0)):
        near, far = getattr(many, name), getattr(few, name)
        assert near.low < true < near.high
        # 16 times the seeds: a quarter of the width, give or take the noise of either
        assert (near.high - near.low) < 0.5 * (far.high - far.low)


def test_a_minimum_at_an_end_is_no_best_lead() -> None:
    found = ForesightStatistics(rows_of(lambda cell: 40.0), resamples=9)
    assert {best.lead.mean for best in found.best_leads} == {None}
    assert found.laws == []


def test_the_gain_is_that_of_common_seeds() -> None:
    rows = rows_of(law)
    # A seed without its episode at a lead of 0 is left out.
    left_out = Cell("sway", 8, "direct", "truth", 0)
    rows = [row for row in rows if row.key != (left_out, 5)]
    found = {b.setting: b.gain for b in ForesightStatistics(rows, resamples=99).best_leads}
    gain = found[Setting("sway", 8, "direct")]
    assert gain is not None
    assert (gain.difference.mean, gain.difference.n, gain.wins, gain.losses) == (1.0, 39, 39, 0)
    none = found[Setting("sway", 0, "direct")]  # 3 frames off is near enough
    assert none is not None
    assert none.difference.mean == 0.0


def test_cells_are_counted() -> None:
    found = ForesightStatistics(rows_of(law), resamples=9).cells
    assert [c.cell for c in found] == sorted(CELLS)
    first = found[0]
    assert (first.cell.lead, first.n, first.success.count, first.strict.count) == (0, 40, 40, 40)
    assert first.force == pytest.approx(np.percentile(np.arange(40), 90))
    assert first.tracking_error == pytest.approx(np.sqrt(1e-6 * (1.0 + 0.25 * 2.5**2)))


def test_tables_hold_every_cell_and_every_setting() -> None:
    best, latency, cells = study_tables(ForesightStatistics(rows_of(law), resamples=99))
    assert (len(best.rows), len(latency.rows), len(cells.rows)) == (5, 2, len(CELLS))
    assert [cell.text for cell in latency.rows[0].cells] == [
        "all",
        "1.10 (1.10 … 1.10)",
        "2.50 (2.50 … 2.50)",
        "8.00 (8.00 … 8.00)",
        "5",
    ]


def test_grids_hold_each_cell_once_and_leads_about_the_expected_one() -> None:
    for preset in PRESETS.values():
        assert len(set(preset.cells)) == len(preset.cells)
    assert [cell.lead for cell in lead_cells("sway", (0, 8))] == [0, 3, 6, 0, 8, 11, 14]
    assert [cell.lead for cell in lead_cells("sway", (12,), "ensemble")] == [0, 21, 24]
    assert expected_lead(4, "ensemble") == 16
    (one,) = forecaster_cells("sway", (4,), ("kalman",))
    assert one == Cell("sway", 4, "direct", "kalman", 7)
