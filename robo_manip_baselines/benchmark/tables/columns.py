"""Columns of tables with a row for each condition: formats, `Statistic`, and what is made of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from robo_manip_baselines.benchmark.statistics.analysis import ConditionStatistics
from robo_manip_baselines.benchmark.statistics.inference import SIGNIFICANCE
from robo_manip_baselines.benchmark.statistics.outcomes import RowSelection
from robo_manip_baselines.benchmark.tables.table import NOTHING, Cell, Column, Row, Table


def percent(rate: float) -> str:
    """Format a rate, ``74.0 %``."""
    return f"{100.0 * rate:.1f} %"


def points(difference: float) -> str:
    """Format a difference of rates in percentage points, ``−3.5``."""
    return _signed(f"{100.0 * difference:+.1f}")


def seconds(time: float) -> str:
    """Format a time in seconds, ``4.31``."""
    return f"{time:.2f}"


def later(difference: float) -> str:
    """Format a difference of times in seconds, ``+0.20``."""
    return _signed(f"{difference:+.2f}")


def p_text(p: float) -> str:
    """Format a p-value."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _signed(number: str) -> str:
    """Write a minus sign, and no sign before zero."""
    return number.lstrip("+-") if float(number) == 0.0 else number.replace("-", "−")


def ends(text: Callable[[float], str]) -> Callable[[float, float], str]:
    """Return the function that formats both ends of an interval."""
    return lambda low, high: f"{text(low)} to {text(high)}".replace(" % to", " to")


# Which cells of a column are in bold, from a value and all values of the column.


def highest(value: float, column: Sequence[float]) -> bool:
    """Return whether a value is the highest of its column."""
    return value == max(column)


def lowest(value: float, column: Sequence[float]) -> bool:
    """Return whether a value is the lowest of its column."""
    return value == min(column)


def significant(value: float, _: Sequence[float]) -> bool:
    """Return whether a p-value is called significant."""
    return value < SIGNIFICANCE


RowsOf = dict[str, Any] | Callable[[ConditionStatistics], dict[str, Any]]
"""Attributes of `RowSelection` beside the condition, the same for all or those of each."""


@dataclass(frozen=True)
class Statistic:
    """Column of a statistic of all conditions.

    Attributes:
        title: heading.
        names: of the values in the CSV, with spaces between them.
        text: formats the values for readers.
        values: paths of attributes of `ConditionStatistics`, one for each name; or a function that
            returns the values. A cell whose first value is None is empty.
        rows: selects the result rows that the values are computed from, by the attributes of
            `RowSelection` beside the condition, or a function that returns these; None if from
            none.
        strong: whether a value is set in bold, given all of the column; never if None.
        is_text: whether cells hold words, not numbers.
    """

    title: str
    names: str
    text: Callable[..., str]
    values: str | Callable[[ConditionStatistics], tuple[Any, ...]]
    rows: RowsOf | None
    strong: Callable[[Any, Sequence[Any]], bool] | None = None
    is_text: bool = False

    @property
    def column(self) -> Column:
        """Column of the table."""
        return Column(self.title, tuple(self.names.split()), self.is_text)

    def cells(self, conditions: Sequence[ConditionStatistics]) -> list[Cell]:
        """Make the cells of all conditions."""
        if callable(self.values):
            values = list(map(self.values, conditions))
        else:
            getters = [attrgetter(path) for path in self.values.split()]
            values = [tuple(get(c) for get in getters) for c in conditions]
        found = [value[0] for value in values if value[0] is not None]
        return [
            make_cell(
                value,
                self.text,
                self._rows_of(c),
                lambda value: self.strong is not None and self.strong(value, found),
            )
            for c, value in zip(conditions, values, strict=True)
        ]

    def _rows_of(self, c: ConditionStatistics) -> RowSelection | None:
        if self.rows is None:
            return None
        rows = self.rows(c) if callable(self.rows) else self.rows
        return RowSelection(c.condition.name, **rows)


def make_cell(
    values: tuple[Any, ...],
    text: Callable[..., str],
    rows: RowSelection | None = None,
    is_strong: Callable[[Any], bool] = lambda value: False,
) -> Cell:
    """Make a cell; empty, without result rows, where the first value is None."""
    if values[0] is None:
        return Cell(NOTHING, values)
    return Cell(text(*values), values, rows, is_strong(values[0]))


ALL: dict[str, Any] = {}
SUCCESSES = {"is_success": True}
STRICT = {"is_strict": True}


def interval(
    title: str,
    text: Callable[[float], str],
    estimate: str,
    rows: RowsOf,
    prefix: str = "",
) -> Statistic:
    """Make the column of a 95 % interval, given the path of an estimate."""
    names = f"{prefix}low {prefix}high"
    return Statistic(title, names, ends(text), f"{estimate}.low {estimate}.high", rows)


def p_values(test: str, comparison: str, rows: RowsOf) -> list[Statistic]:
    """Make the columns of a test's p-values, given the path of a comparison."""
    return [
        Statistic(f"{test} p", "p", p_text, f"{comparison}.p", rows),
        Statistic("Holm p", "p_holm", p_text, f"{comparison}.p_holm", rows, significant),
    ]


def beside_paper(
    test: str, comparison: str, unit: str, text: Callable[[float], str], rows: dict[str, Any]
) -> list[Statistic]:
    """Make the columns of a comparison with published results, given its path."""

    def is_compatible(c: ConditionStatistics) -> tuple[bool | None]:
        p = getattr(c, comparison).p_holm
        return (None if p is None else p >= SIGNIFICANCE,)

    yes_or_no = {True: "yes", False: "no"}.__getitem__
    difference = f"{comparison}.difference"
    return [
        Statistic(f"Here − paper{unit}", "difference", text, f"{difference}.mean", rows),
        interval("95 % interval", text, difference, rows),
        *p_values(test, comparison, rows),
        Statistic("Compatible", "is_compatible", yes_or_no, is_compatible, None, is_text=True),
    ]


def condition_table(
    name: str,
    title: str,
    conditions: Sequence[ConditionStatistics],
    columns: Sequence[Statistic],
    notes: Sequence[str],
) -> Table:
    """Make a table with a row for each condition, its label first."""
    labels = [Cell(c.condition.label, (c.condition.name,)) for c in conditions]
    cells = zip(labels, *(column.cells(conditions) for column in columns), strict=True)
    rows = [Row(c.condition.group, own) for c, own in zip(conditions, cells, strict=True)]
    head = Column("Condition", ("condition",), is_text=True)
    return Table(name, title, (head, *(c.column for c in columns)), tuple(rows), tuple(notes))
