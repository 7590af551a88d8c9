"""The files of results: ``tables.md``, ``table1.csv``, ``table2.csv`` and ``results.json``.

Tables I and II of the paper stand beside the measured ones as printed, from its authors' own
recordings ("Improving Robotic Imitation Learning with Predicted Facial Motion Using Transformers",
section IV.B: 100 sequences, five forecast frames of each). Its variances cannot be variances of
errors in these units: a quantity between 0 and 1 with mean 0.017 has none above 0.0167.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.evaluation.error_stats import compact_json
from face_prediction.evaluation.errors import LEVELS
from face_prediction.evaluation.setup import PERSISTENCE
from face_prediction.evaluation.statistics import GROUPS, BootstrapEstimate, KindSummary
from robo_manip_baselines.runs.files import write_text

Place = int | tuple[int, ...]
Format = Callable[[float], str]

SCHEMA = "face_evaluation"
VERSION = 1
PAPER_TABLE_1: tuple[tuple[str, tuple[float | None, ...]], ...] = (
    ("approach 1, images only", (None, None, None, None, 0.662)),
    ("approach 2, simple fusion", (0.032, 0.061, 0.036, 0.130, 0.818)),
    ("approach 3, cross-attention", (0.015, 0.013, 0.017, 0.025, 0.928)),
)
"""Columns of the paper's Table I: mean and variance of abs dU and dV, SSIM; None: a dash."""
PAPER_TABLE_2: dict[str, tuple[float, ...]] = {
    "mean dU": (0.010, 0.019, 0.013, 0.020, 0.014),
    "var dU": (0.010, 0.014, 0.014, 0.013, 0.014),
    "mean dV": (0.013, 0.021, 0.015, 0.017, 0.017),
    "var dV": (0.021, 0.027, 0.026, 0.025, 0.027),
    "SSIM": (0.926, 0.927, 0.928, 0.928, 0.929),
}
"""Approach 3 by frame."""
PER_FRAME: tuple[tuple[str, str, int | None], ...] = (
    ("mean dU", "mean", 0),
    ("var dU", "variance", 0),
    ("mean dV", "mean", 1),
    ("var dV", "variance", 1),
    ("SSIM", "ssim", None),
)
"""Metrics of Table II: heading, key of `KindSummary.numbers`, axis (U, V; None: there is none)."""
TABULATED_LEVELS = (0.5, 0.9)
"""Nominal coverages in the tables."""
INTRODUCTION = """Everybody is forecast by predictors that never saw the person. Errors are of the
mouth centre (mean of the lip landmarks), as shares of the crop; a frame without a forecast is
missing and enters no mean. In brackets: 95 % intervals from resampling people, and sequences within
each. Kinds of footage are apart, because pooling flatters. Variances are of the frames, divided by
their number. NME: mean distance over all landmarks / distance between the outer eye corners.
SSIM: scikit-image, Gaussian window of 1.5 pixels, in colour. All images are compared at one size,
the smallest that any row makes, larger ones brought there by averaging areas; persistence copies
the last image. Rows of the paper are its printed figures, from its own recordings."""

_NOTHING = "–"
_DIGITS = 9  # significant digits in CSV and JSON: more than the bootstrap is good for
_error, _variance, _ssim = "{:.4f}".format, "{:.1e}".format, "{:.3f}".format
_skill, _percent, _gain = "{:+.2f}".format, "{:+.1f} %".format, "{:+.3f}".format


@dataclass(frozen=True)
class EvaluationReport:
    """Contents of the files.

    Attributes:
        kinds: numbers of each kind of footage.
        history: frames that predictors see.
        folds: whose people are reported on.
        provenance: of dataset, checkpoints, options and versions, and notes: JSON.
    """

    kinds: tuple[KindSummary, ...]
    history: int
    folds: tuple[int, ...]
    provenance: dict[str, Any]


def write_evaluation_report(folder: Path, report: EvaluationReport) -> None:
    """Write the four files, each whole or not at all.

    Raises:
        RequestError: the folder cannot be written to.
    """
    write_text(folder / "tables.md", markdown_text(report))
    write_text(folder / "table1.csv", _table_1_csv(report))
    write_text(folder / "table2.csv", _table_2_csv(report))
    write_text(folder / "results.json", results_json(report))


def markdown_text(report: EvaluationReport) -> str:
    """``tables.md``."""
    folds = ", ".join(map(str, report.folds))
    parts = [
        "# Forecasts of faces, evaluated",
        INTRODUCTION,
        f"Folds reported on: {folds}. Every row is on the same sequences.",
    ]
    notes = report.provenance.get("notes", [])
    if notes:
        parts.append("\n".join(f"- {note}" for note in notes))
    for summary in report.kinds:
        parts += _kind_sections(summary, report.history)
    return "\n\n".join(parts) + "\n"


def markdown_table_1(summary: KindSummary) -> str:
    """Table I: mean and variance of abs dU and abs dV, SSIM, NME, and what is missing."""
    numbers = summary.numbers
    makes_images = any(row.role == "network" and row.image_size for row in summary.rows)
    makes_larger = any(row.image_size > summary.common_size for row in summary.rows)
    head = ["", "mean dU", "var dU", "mean dV", "var dV", f"SSIM at {summary.common_size} px"]
    head += ["SSIM more than the copy's"] if makes_images else []
    head += ["SSIM at own size", "copy at that size"] if makes_larger else []
    head += ["NME", "missing"]
    rows: list[list[str]] = []
    for i, row in enumerate(summary.rows):
        cells = [row.name]
        for axis in range(2):
            cells += _cells(numbers["pooled_mean"], (i, axis), _error)
            cells.append(_number(numbers["pooled_variance"].value[i, axis], _variance))
        cells += _cells(numbers["pooled_ssim"], i, _ssim)
        if makes_images:
            gain = _cells(numbers["pooled_ssim_gain"], i, _gain, " to ")
            cells += [""] if row.name == PERSISTENCE else gain
        if makes_larger:
            for key in ("pooled_ssim_own_size", "pooled_ssim_copy_own_size"):
                (ssim,) = _cells(numbers[key], i, _ssim)
                is_larger = row.image_size > summary.common_size
                cells.append(f"{ssim} at {row.image_size} px" if is_larger else "")
        missing, frames = int(row.missing.sum()), summary.sequences * summary.horizon
        cells.append(_number(numbers["pooled_nme"].value[i], _ssim))
        rows.append([*cells, f"{missing} of {frames}" if missing else "0"])
    for name, values in PAPER_TABLE_1:
        printed = [_NOTHING if value is None else f"{value:.3f}" for value in values]
        cells = [f"paper, {name} (other data)", *printed[:-1], f"{printed[-1]} at 256 px"]
        rows.append(cells + [""] * (len(head) - len(cells)))
    return _table(head, rows)


def results_json(report: EvaluationReport) -> str:
    """``results.json``: every number, and the provenance."""
    return compact_json(
        {
            "schema": SCHEMA,
            "version": VERSION,
            **report.provenance,
            "history": report.history,
            "folds": report.folds,
            "coverage_levels": LEVELS,
            "horizon_groups": GROUPS,
            "kinds": {summary.kind: _kind_record(summary) for summary in report.kinds},
        }
    )


def _kind_sections(summary: KindSummary, history: int) -> list[str]:
    """Sections on one kind of footage; ``history`` frames are seen, so that 71 is the next."""
    people = "person" if summary.subjects == 1 else "people"
    rows, numbers = list(enumerate(summary.rows)), summary.numbers
    frames = [str(history + h + 1) for h in range(summary.horizon)]
    spans = [f"{history + first}–{history + last}" for first, last in GROUPS]
    heads = [f"frames {span}" for span in spans]
    parts = [
        f"## {summary.kind}: {summary.sequences} sequences of {summary.subjects} {people}, "
        f"{summary.clips} clips"
    ]
    if summary.subjects < 5:
        parts.append(f"With {summary.subjects} {people} the intervals say little about others.")
    parts += [
        "### Table I: errors of the mouth centre in crops, and SSIM",
        markdown_table_1(summary),
        "### Distance between forecast and true mouth centre, in crops",
        _table(
            ["", *frames, "all"],
            (
                [
                    row.name,
                    *_cells(numbers["distance"], i, _error),
                    *_cells(numbers["pooled_distance"], i, _error),
                ]
                for i, row in rows
            ),
        ),
        "### Skill: 1 − mean distance / that of persistence",
        _table(
            ["", *frames, "all"],
            (
                [
                    row.name,
                    *(_number(value, _skill) for value in numbers["skill"].value[i]),
                    *_cells(numbers["pooled_skill"], i, _skill, " to "),
                ]
                for i, row in rows
                if row.role != "reference" and row.name != PERSISTENCE
            ),
        ),
        f"### Mean distance against {summary.best_baseline}, the best baseline at frames "
        f"{spans[1]}",
        _table(
            ["", *heads],
            (
                [row.name, *_cells(numbers["difference"], i, _percent, " to ")]
                for i, row in rows
                if row.role != "reference" and row.name != summary.best_baseline
            ),
        ),
        "### Table II: by forecast frame",
    ]
    for heading, key, axis in PER_FRAME:
        values = numbers[key].value if axis is None else numbers[key].value[..., axis]
        form = {"mean": _error, "variance": _variance, "ssim": _ssim}[key]
        cells = [
            [row.name, *(_number(value, form) for value in values[i])]
            for i, row in rows
            if not np.isnan(values[i]).all()
        ]
        if len(frames) == len(PAPER_TABLE_2[heading]):
            cells.append(["paper, approach 3 (other data)", *map(_ssim, PAPER_TABLE_2[heading])])
        parts.append(_table([heading, *frames], cells))
    with_intervals = [(i, row) for i, row in rows if row.has_intervals]
    if with_intervals:
        parts.append("### Coverage of the mouth centre's intervals, U and V together, in percent")
        cells = []
        for i, row in with_intervals:
            for level in TABULATED_LEVELS:
                k = LEVELS.index(level)
                by_frame = (_number(v, _in_percent) for v in numbers["coverage"].value[i, :, k])
                pooled = _cells(numbers["pooled_coverage"], (i, k), _in_percent)
                cells.append([f"{row.name}, {level:.0%}", *by_frame, *pooled])
        parts.append(_table(["", *frames, "all"], cells))
    shuffled = [(i, row) for i, row in rows if not np.isnan(numbers["exchanged"].value[i]).all()]
    if shuffled:
        parts.append("### Mean distance with another sequence's images against with its own")
        cells = ([r.name, *_cells(numbers["exchanged"], i, _percent, " to ")] for i, r in shuffled)
        parts.append(_table(["", *heads, "all"], cells))
    return parts


def _cells(
    estimate: BootstrapEstimate, place: Place, form: Format, between: str = "–"
) -> list[str]:
    """Cells of the numbers at ``place``, each with its interval."""
    return [
        _NOTHING if np.isnan(value) else f"{form(value)} ({form(low)}{between}{form(high)})"
        for value, low, high in _bounded(estimate, place)
    ]


def _bounded(estimate: BootstrapEstimate, place: Place) -> Iterable[tuple[float, float, float]]:
    parts = (np.ravel(part[place]) for part in (estimate.value, estimate.low, estimate.high))
    return zip(*parts, strict=True)


def _number(value: float, form: Format) -> str:
    return _NOTHING if np.isnan(value) else form(value)


def _in_percent(value: float) -> str:
    return f"{100 * value:.1f}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def _table_1_csv(report: EvaluationReport) -> str:
    """A line for each kind of footage and row; the bounds of intervals in columns of their own."""
    names = ("mean_du", "var_du", "mean_dv", "var_dv", "ssim", "ssim_own_size",
             "ssim_copy_own_size", "nme", "distance", "skill")  # fmt: skip
    head = ["kind", "row", "role", "sequences", "subjects", "missing", "picture_size", "ssim_size"]
    lines: list[list[Any]] = [head + [f"{n}{end}" for n in names for end in ("", "_low", "_high")]]
    for summary in report.kinds:
        numbers = summary.numbers
        for i, row in enumerate(summary.rows):
            line = [summary.kind, row.name, row.role, summary.sequences, summary.subjects]
            line += [row.missing.sum(), row.image_size or "", summary.common_size]
            for axis in range(2):
                line += _csv_cells(numbers["pooled_mean"], (i, axis))
                line += _csv_cells(numbers["pooled_variance"], (i, axis))
            for name in names[4:]:
                line += _csv_cells(numbers[f"pooled_{name}"], i)
            lines.append(line)
    for name, values in PAPER_TABLE_1:
        line = ["paper (other data)", name, "paper", 100, "", "", 256, 256]
        for value in values:
            line += ["" if value is None else value, "", ""]
        lines.append(line + [""] * (len(lines[0]) - len(line)))
    return _csv(lines)


def _table_2_csv(report: EvaluationReport) -> str:
    """A line for each kind, row, metric and frame."""
    lines: list[list[Any]] = [
        ["kind", "row", "role", "metric", "frame", "value", "low", "high"],
    ]
    others = (("distance", "distance", None), ("skill", "skill", None), ("NME", "nme", None))
    for summary in report.kinds:
        for i, row in enumerate(summary.rows):
            for heading, key, axis in (*PER_FRAME, *others):
                for h in range(summary.horizon):
                    place = (i, h) if axis is None else (i, h, axis)
                    line = [summary.kind, row.name, row.role, heading, report.history + h + 1]
                    lines.append(line + _csv_cells(summary.numbers[key], place))
    for heading, values in PAPER_TABLE_2.items():
        for frame, value in enumerate(values, start=71):
            line = ["paper (other data)", "approach 3, cross-attention", "paper", heading, frame]
            lines.append([*line, value, "", ""])
    return _csv(lines)


def _csv_cells(estimate: BootstrapEstimate, place: Place) -> list[str]:
    ((value, low, high),) = _bounded(estimate, place)
    return ["" if np.isnan(part) else f"{part:.{_DIGITS}g}" for part in (value, low, high)]


def _csv(lines: Iterable[Iterable[Any]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()


def _kind_record(summary: KindSummary) -> dict[str, Any]:
    return {
        "sequences": summary.sequences,
        "subjects": summary.subjects,
        "clips": summary.clips,
        "ssim_size": summary.common_size,
        "best_baseline": summary.best_baseline,
        "rows": [
            {
                "name": row.name,
                "role": row.role,
                "picture_size": row.image_size,
                "missing": row.missing.tolist(),
                "numbers": {
                    key: {
                        part: _rounded(getattr(number, part)[i].tolist())
                        for part in ("value", "low", "high")
                    }
                    for key, number in summary.numbers.items()
                    if not np.isnan(number.value[i]).all()
                },
            }
            for i, row in enumerate(summary.rows)
        ],
    }


def _rounded(values: Any) -> Any:
    """Nested lists of rounded numbers; None for NaN."""
    if isinstance(values, list):
        return [_rounded(value) for value in values]
    return None if np.isnan(values) else float(f"{values:.{_DIGITS}g}")
