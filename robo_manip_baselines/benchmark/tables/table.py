"""Tables, and their files as Markdown, CSV and LaTeX; the report writes them as HTML."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from robo_manip_baselines.benchmark.statistics.outcomes import RowSelection
from robo_manip_baselines.runs.files import write_text

Value = str | int | float | bool | None

NOTHING = "–"
"""Text of a cell without a value."""


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes:
        title: its heading.
        names: of the values of a cell, each a column of the CSV.
        is_text: whether cells hold words, not numbers.
    """

    title: str
    names: tuple[str, ...]
    is_text: bool = False


@dataclass(frozen=True)
class Cell:
    """Cell of a table.

    Attributes:
        text: for readers.
        values: the same for machines, one for each name of the column. The first one sorts.
        selection: result rows that it is computed from; None if from none.
        is_strong: whether it is set in bold, as the best of a column.
    """

    text: str
    values: tuple[Value, ...]
    selection: RowSelection | None = None
    is_strong: bool = False


@dataclass(frozen=True)
class Row:
    """Row of a table; rows of the same group are neighbours."""

    group: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """Table with a title and notes.

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
    body = [_texts(row, _markdown, "**{}**") for row in table.rows]
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
        lines.append(" & ".join(_texts(row, _latex, r"\textbf{{{}}}")) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
    lines += [f"% {note}" for note in table.notes]
    return "\n".join(lines) + "\n"


FORMATS = {"md": to_markdown, "csv": to_csv, "tex": to_latex}
"""Extension of a file -> function that makes its content."""


def write_tables(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """Write every table in every format, for example ``success.md``; return the paths."""
    paths = []
    for table in tables:
        for extension, content in FORMATS.items():
            paths.append(folder / f"{table.name}.{extension}")
            write_text(paths[-1], content(table))
    return paths


def _texts(row: Row, escape: Callable[[str], str], strong: str) -> list[str]:
    """Return the escaped texts of a row's cells, those in bold within ``strong``."""
    return [strong.format(escape(c.text)) if c.is_strong else escape(c.text) for c in row.cells]


def _csv(value: Value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) else str(value)


def _markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>\[\]&$~])", r"\\\1", text)


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
