"""Statistics of the value of foresight: rates of cells, the best lead, and what explains it.

The best lead of a motion, delay and execution is where the tracking error is least: the square of
the error of a servo that aims some frames off is quadratic in these frames, so that a parabola
through the three leads about the smallest mean square gives it between whole frames. Success does
not say it as well: it stays at 100 % over several leads.

Legend: E seeds, B resamples, S settings (motion, delay, execution) with a best lead, P terms of the
line.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.benchmark.foresight.episodes import Cell, ForesightRow
from robo_manip_baselines.benchmark.foresight.grid import expected_lead
from robo_manip_baselines.benchmark.statistics.inference import (
    RESAMPLES,
    Comparison,
    Estimate,
    paired_success,
)
from robo_manip_baselines.rollout.results import CONFIDENCE, Proportion
from robo_manip_baselines.runs.seeds import stream_generator

Floats = NDArray[np.float64]

FORCE_PERCENTILE = 90.0


class Setting(NamedTuple):
    """Cells that differ in lead and forecaster alone."""

    motion: str
    delay: int
    execution: str


class CellStatistics(NamedTuple):
    """Statistics of a cell.

    Attributes:
        cell: of the grid.
        success, strict: proportions, with Wilson's intervals.
        force: N, 90th percentile over episodes of the largest on the face.
        tracking_error: m, root of the mean square over episodes; None without any.
        n: episodes.
    """

    cell: Cell
    success: Proportion
    strict: Proportion
    force: float
    tracking_error: float | None
    n: int


class BestLead(NamedTuple):
    """Lead with the least tracking error, in frames.

    Attributes:
        setting: of the cells.
        lead: with an interval by bootstrap over seeds; without a mean if the smallest error is at
            the shortest or longest lead of the grid.
        expected: frames, see `expected_lead`.
        gain: strict success with the expected lead minus that with none, on common seeds.
    """

    setting: Setting
    lead: Estimate
    expected: int
    gain: Comparison | None


class LatencyLaw(NamedTuple):
    """Line through best leads: lead = slope delay + lag + age, the age for an ensemble alone.

    Attributes:
        motion: of the settings; empty for all motions.
        slope: frames of lead for each frame of delay.
        lag: frames, of the arm.
        age: frames, that the ensemble adds; without a mean where no setting has it.
        n: settings, S.
    """

    motion: str
    slope: Estimate
    lag: Estimate
    age: Estimate
    n: int


@dataclass(frozen=True)
class ForesightStatistics:
    """Statistics of all rows of a study.

    Attributes:
        rows: of its cells.
        resamples: B.
    """

    rows: Sequence[ForesightRow]
    resamples: int = RESAMPLES

    @cached_property
    def of_cell(self) -> dict[Cell, dict[int, ForesightRow]]:
        """Rows by cell and seed."""
        found: dict[Cell, dict[int, ForesightRow]] = defaultdict(dict)
        for row in self.rows:
            found[row.cell][row.seed] = row
        return dict(sorted(found.items()))

    @cached_property
    def cells(self) -> list[CellStatistics]:
        """Statistics of every cell."""
        return [_cell_statistics(cell, list(rows.values())) for cell, rows in self.of_cell.items()]

    @cached_property
    def best_leads(self) -> list[BestLead]:
        """Best lead of every setting that has three leads or more."""
        return [
            BestLead(
                setting,
                _estimate(*self._vertices[setting]) if setting in self._vertices else _NONE,
                expected_lead(setting.delay, setting.execution),
                self._gain(setting),
            )
            for setting, leads in self._leads.items()
            if len(leads) > 2
        ]

    @cached_property
    def laws(self) -> list[LatencyLaw]:
        """Line of all motions, then that of each motion with two settings or more."""
        motions = {setting.motion: None for setting in self._vertices}
        groups = [("", list(self._vertices))]
        groups += [(m, [s for s in self._vertices if s.motion == m]) for m in motions]
        return [self._law(*group) for group in groups if len({s.delay for s in group[1]}) > 1]

    @cached_property
    def _leads(self) -> dict[Setting, list[int]]:
        """Leads of the true future, ascending."""
        found: dict[Setting, list[int]] = defaultdict(list)
        for cell in self.of_cell:
            if cell.forecaster == "truth":
                found[Setting(cell.motion, cell.delay, cell.execution)].append(cell.lead)
        return {setting: sorted(leads) for setting, leads in found.items()}

    @cached_property
    def _seeds(self) -> list[int]:
        return sorted({row.seed for row in self.rows})

    @cached_property
    def _counts(self) -> Floats:
        """(B, E): how often each seed is in a resample; the same for all settings."""
        rng, number = stream_generator(0, "foresight"), len(self._seeds)
        return rng.multinomial(number, np.full(number, 1.0 / number), self.resamples).astype(float)

    @cached_property
    def _vertices(self) -> dict[Setting, tuple[float, Floats, int]]:
        """Best lead, that of every resample (B,), and the number of seeds."""
        found = {}
        for setting, leads in self._leads.items():
            squares = np.stack([self._squares(setting, lead) for lead in leads], axis=1)  # (E, L)
            is_whole = np.isfinite(squares).all(axis=1)
            if len(leads) < 3 or is_whole.sum() < 2:
                continue
            best = int(np.argmin(squares[is_whole].mean(axis=0)))
            if not 0 < best < len(leads) - 1:
                continue
            near, three = squares[is_whole, best - 1 : best + 2], leads[best - 1 : best + 2]
            means = self._counts[:, is_whole] @ near  # a parabola's vertex needs no division
            value = float(vertex(np.array(three), near.mean(axis=0)))
            found[setting] = value, vertex(np.array(three), means), int(is_whole.sum())
        return found

    def _squares(self, setting: Setting, lead: int) -> Floats:
        """(E,) m^2, NaN without a tracking error."""
        rows = self.of_cell[Cell(*setting, "truth", lead)]
        errors = [rows[seed].tracking_error if seed in rows else None for seed in self._seeds]
        return np.array([np.nan if error is None else error**2 for error in errors])

    def _gain(self, setting: Setting) -> Comparison | None:
        leads = (expected_lead(setting.delay, setting.execution), 0)
        cells = [self.of_cell.get(Cell(*setting, "truth", lead), {}) for lead in leads]
        common = sorted(set(cells[0]) & set(cells[1]))
        if not common:
            return None
        grids = [np.array([[float(c[s].is_success_strict) for s in common]]) for c in cells]
        ours, theirs = grids
        rng = stream_generator(0, "foresight gain", setting.delay)
        return paired_success(ours, theirs, rng, self.resamples)

    def _law(self, motion: str, settings: Sequence[Setting]) -> LatencyLaw:
        has_ensemble = [setting.execution == "ensemble" for setting in settings]
        terms = [[s.delay for s in settings], [1.0] * len(settings), has_ensemble]
        design = np.array(terms, dtype=np.float64).T[:, : 3 if any(has_ensemble) else 2]
        leads = np.array([self._vertices[setting][0] for setting in settings])
        resampled = np.stack([self._vertices[setting][1] for setting in settings], axis=1)  # (B, S)
        inverse = np.linalg.pinv(design)
        fitted, spread = inverse @ leads, resampled @ inverse.T  # (P,), (B, P)
        n = len(settings)
        estimates = [_estimate(float(v), spread[:, k], n) for k, v in enumerate(fitted)]
        slope, lag, age = (*estimates, _NONE)[:3]
        return LatencyLaw(motion, slope, lag, age, n)


def vertex(leads: NDArray[np.float64], values: Floats) -> Floats:
    """Return the abscissa (...) of the vertex of the parabola through three points.

    Args:
        leads: (3,), ascending.
        values: (..., 3).
    """
    first, second = np.diff(leads)
    down, up = (values[..., 1] - values[..., 0]) / first, (values[..., 2] - values[..., 1]) / second
    curvature = (up - down) / (first + second)
    with np.errstate(divide="ignore", invalid="ignore"):  # three equal values have no vertex
        return (leads[0] + leads[1]) / 2.0 - down / (2.0 * curvature)


_NONE = Estimate(None, None, None, 0)


def _estimate(value: float, resampled: Floats, n: int) -> Estimate:
    """Return a value with its percentile interval."""
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.nanpercentile(resampled, [tail, 100.0 - tail])
    return Estimate(value, float(low), float(high), n)


def _cell_statistics(cell: Cell, rows: Sequence[ForesightRow]) -> CellStatistics:
    squares = [row.tracking_error**2 for row in rows if row.tracking_error is not None]
    return CellStatistics(
        cell,
        Proportion.of(sum(row.is_success for row in rows), len(rows)),
        Proportion.of(sum(row.is_success_strict for row in rows), len(rows)),
        float(np.percentile([row.face_force for row in rows], FORCE_PERCENTILE)),
        float(np.sqrt(np.mean(squares))) if squares else None,
        len(rows),
    )
