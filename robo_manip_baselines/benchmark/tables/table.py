"""A table once, written as Markdown, CSV or LaTeX; the report writes it as HTML."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robo_manip_baselines.benchmark.statistics.outcomes import Selection
from robo_manip_baselines.runs.files import atomic_file

Value = str | int | float | bool | None

NOTHING = "–"
"""stands where there is no figure."""


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        title: what a reader is shown.
        names: of the values of a cell, each a column of the CSV.
        is_text: whether cells hold words, not figures.
    """

    title: str
    names: tuple[str, ...]
    is_text: bool = False


@dataclass(frozen=True)
class Cell:
    """What stands in a row and a column.

    Attributes:
        text: what a reader is shown.
        values: the same for machines, one for each name of the column. The first one sorts.
        selection: result lines that it comes from; None for what does not come from any.
        is_strong: whether it is set in bold, as the best of a column.
    """

    text: str
    values: tuple[Value, ...]
    selection: Selection | None = None
    is_strong: bool = False


@dataclass(frozen=True)
class Row:
    """A row; rows of the same group stand together."""

    group: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: of its files, without ending.
        title: above the table.
        notes: below it, a sentence or more each.
        columns, rows: its content.

    Raises:
        ValueError: a row has more or fewer cells, or a cell more or fewer values, than declared.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            for column, cell in zip(self.columns, row.cells, strict=True):
                if len(cell.values) != len(column.names):
                    raise ValueError(f"'{cell.text}' has not the values {', '.join(column.names)}")


def to_markdown(table: Table) -> str:
    """Return a table in GitHub's Markdown, with title and notes."""

    def line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cells)} |"

    head = [_markdown(column.title) for column in table.columns]
    rules = ["---" if column.is_text else "--:" for column in table.columns]
    body = [
        [f"**{_markdown(cell.text)}**" if cell.is_strong else _markdown(cell.text) for cell in row]
        for row in (row.cells for row in table.rows)
    ]
    lines = [f"**{_markdown(table.title)}**", "", line(head), line(rules), *map(line, body)]
    if table.notes:
        lines += ["", " ".join(map(_markdown, table.notes))]
    return "\n".join(lines) + "\n"


def to_csv(table: Table) -> str:
    """Return a table's values as CSV: full precision, a column for every value, empty for none."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["group", *(name for column in table.columns for name in column.names)])
    for row in table.rows:
        writer.writerow([row.group, *(_csv(v) for cell in row.cells for v in cell.values)])
    return stream.getvalue()


def to_latex(table: Table) -> str:
    r"""Return a table for LaTeX with ``\usepackage{booktabs}``, notes as comments below it."""
    groups = [row.group for row in table.rows]
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_latex(table.title)}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\begin{{tabular}}{{{''.join('l' if c.is_text else 'r' for c in table.columns)}}}",
        r"\toprule",
        " & ".join(_latex(column.title) for column in table.columns) + r" \\",
        r"\midrule",
    ]
    for number, row in enumerate(table.rows):
        if number and groups[number - 1] != row.group:
            lines.append(r"\addlinespace")
        cells = [
            rf"\textbf{{{_latex(cell.text)}}}" if cell.is_strong else _latex(cell.text)
            for cell in row.cells
        ]
        lines.append(" & ".join(cells) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
    lines += [f"% {note}" for note in table.notes]
    return "\n".join(lines) + "\n"


FORMATS = {"md": to_markdown, "csv": to_csv, "tex": to_latex}
"""Ending of the file -> how its content is made."""


def write_tables(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """Write every table in every format, for example ``success.md``; return the paths."""
    paths = []
    for table in tables:
        for ending, written in FORMATS.items():
            path = folder / f"{table.name}.{ending}"
            with atomic_file(path) as temporary:
                temporary.write_text(written(table), encoding="utf-8")
            paths.append(path)
    return paths


def _csv(value: Value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) else str(value)


def _markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>\[\]])", r"\\\1", text)


_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "−": "$-$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "–": "--",
    "“": "``",
    "”": "''",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}


def _latex(text: str) -> str:
    return "".join(_LATEX.get(sign, sign) for sign in text)
