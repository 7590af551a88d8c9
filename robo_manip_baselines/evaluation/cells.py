"""What the tables of a benchmark are made of: a row for each arm, figures spelt alike."""

from __future__ import annotations

from collections.abc import Callable

from robo_manip_baselines.evaluation.statistics.comparison import SIGNIFICANCE
from robo_manip_baselines.evaluation.statistics.lines import Selection
from robo_manip_baselines.evaluation.statistics.study import ArmFigures, Study
from robo_manip_baselines.evaluation.tables import NOTHING, Cell, Column, Row, Table

ARM = Column("Arm", ("arm",), is_text=True)


def arm_table(
    study: Study,
    name: str,
    title: str,
    columns: tuple[Column, ...],
    cells: Callable[[ArmFigures], list[Cell] | None],
    notes: tuple[str, ...],
) -> Table:
    """Make a table with a row for each arm for which there are cells."""
    rows = [(figures.arm.group, cells(figures)) for figures in study.arms]
    return Table(
        name, title, columns, tuple(Row(group, tuple(row)) for group, row in rows if row), notes
    )


def arm_cell(figures: ArmFigures) -> Cell:
    """Make the first cell of a row."""
    return Cell(figures.arm.label, (figures.arm.name,))


def reference_label(study: Study) -> str:
    """Return what the tables call the arm that others are compared with."""
    reference = study.of(study.reference)
    return f"“{reference.arm.label if reference else study.reference}”"


def percent(rate: float | None) -> str:
    """Spell a rate, ``74.0 %``."""
    return NOTHING if rate is None else f"{100.0 * rate:.1f} %"


def points(difference: float | None) -> str:
    """Spell a difference of rates in percentage points, ``−3.5``."""
    return NOTHING if difference is None else _signed(f"{100.0 * difference:+.1f}")


def seconds(time: float | None) -> str:
    """Spell a time in seconds, ``4.31``."""
    return NOTHING if time is None else f"{time:.2f}"


def later(difference: float | None) -> str:
    """Spell a difference of times in seconds, ``+0.20``."""
    return NOTHING if difference is None else _signed(f"{difference:+.2f}")


def interval_cell(
    low: float | None,
    high: float | None,
    text: Callable[[float], str],
    selection: Selection | None,
) -> Cell:
    """Make a cell of an interval whose ends ``text`` spells."""
    if low is None or high is None:
        return Cell(NOTHING, (None, None))
    return Cell(f"{text(low)} to {text(high)}".replace(" % to", " to"), (low, high), selection)


def p_cell(p: float | None, selection: Selection, *, is_strong: bool = False) -> Cell:
    """Make a cell of a p-value, in bold if asked for and the value is small."""
    if p is None:
        return Cell(NOTHING, (None,))
    text = "< 0.001" if p < 0.001 else f"{p:.3f}"
    return Cell(text, (p,), selection, is_strong=is_strong and p < SIGNIFICANCE)


def compatible_cell(corrected_p: float | None) -> Cell:
    """Make a cell that says whether a test left two figures compatible."""
    if corrected_p is None:
        return Cell(NOTHING, (None,))
    is_compatible = corrected_p >= SIGNIFICANCE
    return Cell("yes" if is_compatible else "no", (is_compatible,))


def _signed(number: str) -> str:
    """Write a minus sign, and no sign before zero."""
    if float(number) == 0.0:
        return number.lstrip("+-")
    return number.replace("-", "−")
