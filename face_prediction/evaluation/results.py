"""The files of an evaluation: ``tables.md``, ``table1.csv``, ``table2.csv``, ``results.json``.

The same numbers give the same bytes.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.evaluation.calibration import LEVELS
from face_prediction.evaluation.published import TABLE_1, TABLE_2
from face_prediction.evaluation.summary import GROUPS, Estimate, KindSummary
from face_prediction.evaluation.tables import PER_FRAME, kind_section
from face_prediction.whole_file import whole_file

SCHEMA = "face_evaluation"
VERSION = 1
#: Significant digits of numbers in the files: more than the bootstrap is good for.
_DIGITS = 9
PAPER = "paper (other data)"

INTRODUCTION = """Everybody is forecast by predictors that never saw the person. Errors are of the
mouth centre (mean of the lip landmarks), as shares of the crop; a frame without a forecast is
missing and enters no mean. In brackets: 95 % intervals from resampling people, and sequences within
each. Kinds of footage are apart, because pooling flatters. Variances are of the frames, divided by
their number. NME: mean distance over all landmarks / distance between the outer eye corners.
SSIM: scikit-image, Gaussian window of 1.5 pixels, in colour. All pictures are compared at one size,
the smallest that any row makes, larger ones brought there by averaging areas; persistence copies
the last picture. Rows of the paper are its printed figures, from its own recordings."""


@dataclass(frozen=True)
class Evaluation:
    """All that is written."""

    kinds: tuple[KindSummary, ...]
    #: frames that predictors see
    history: int
    folds: tuple[int, ...]
    #: of the dataset, the checkpoints, the options and versions: JSON
    provenance: dict[str, Any]


def write_results(folder: Path, evaluation: Evaluation) -> None:
    """Write the four files, each whole or not at all.

    Raises:
        RequestError: the folder cannot be written to.
    """
    for name, text in (
        ("tables.md", markdown(evaluation)),
        ("table1.csv", table_1_csv(evaluation.kinds)),
        ("table2.csv", table_2_csv(evaluation)),
        ("results.json", results_json(evaluation)),
    ):
        with whole_file(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")


def markdown(evaluation: Evaluation) -> str:
    """``tables.md``."""
    folds = ", ".join(map(str, evaluation.folds))
    parts = [
        "# Forecasts of faces, evaluated",
        INTRODUCTION,
        f"Folds reported on: {folds}. Every row is on the same sequences.",
    ]
    notes = evaluation.provenance.get("notes", [])
    if notes:
        parts.append("\n".join(f"- {note}" for note in notes))
    parts += [kind_section(summary, evaluation.history).rstrip() for summary in evaluation.kinds]
    return "\n\n".join(parts) + "\n"


def table_1_csv(kinds: Sequence[KindSummary]) -> str:
    """A line for each kind of footage and row; the bounds of intervals in columns of their own."""
    names = ("mean_du", "var_du", "mean_dv", "var_dv", "ssim", "ssim_own_size",
             "ssim_copy_own_size", "nme", "distance", "skill")  # fmt: skip
    head = ["kind", "row", "role", "sequences", "subjects", "missing", "picture_size", "ssim_size"]
    for name in names:
        head += [name, f"{name}_low", f"{name}_high"]
    lines: list[list[str]] = [head]
    for summary in kinds:
        for i, row in enumerate(summary.rows):
            line = [summary.kind, row, summary.roles[i], str(summary.sequences)]
            line += [str(summary.subjects), str(int(summary.missing[i].sum()))]
            line += [str(summary.picture_sizes[i] or ""), str(summary.common_size)]
            numbers = summary.numbers
            for axis in range(2):
                line += _cells(numbers["pooled_mean"], (i, axis))
                line += _cells(numbers["pooled_variance"], (i, axis))
            for name in names[4:]:
                line += _cells(numbers[f"pooled_{name}"], (i,))
            lines.append(line)
    for paper in TABLE_1:
        values = (paper.mean[0], paper.variance[0], paper.mean[1], paper.variance[1], paper.ssim)
        line = [PAPER, paper.name, "paper", "100", "", "", "256", "256"]
        for value in values:
            line += ["" if value is None else str(value), "", ""]
        lines.append(line + [""] * (len(head) - len(line)))
    return _csv(lines)


def table_2_csv(evaluation: Evaluation) -> str:
    """A line for each kind, row, metric and frame."""
    lines = [["kind", "row", "role", "metric", "frame", "value", "low", "high"]]
    metrics = [
        *PER_FRAME,
        ("distance", "distance", None),
        ("skill", "skill", None),
        ("NME", "nme", None),
    ]
    for summary in evaluation.kinds:
        for i, row in enumerate(summary.rows):
            for heading, key, axis in metrics:
                for h in range(summary.missing.shape[1]):
                    place = (i, h) if axis is None else (i, h, axis)
                    line = [summary.kind, row, summary.roles[i], heading]
                    line.append(str(evaluation.history + h + 1))
                    lines.append(line + _cells(summary.numbers[key], place))
    for heading, values in TABLE_2.items():
        for h, value in enumerate(values):
            line = [PAPER, "approach 3, cross-attention", "paper", heading, str(71 + h)]
            lines.append([*line, str(value), "", ""])
    return _csv(lines)


def results_json(evaluation: Evaluation) -> str:
    """Every number, and what they were made from."""
    record = {
        "schema": SCHEMA,
        "version": VERSION,
        **evaluation.provenance,
        "history": evaluation.history,
        "folds": list(evaluation.folds),
        "coverage_levels": list(LEVELS),
        "horizon_groups": [list(group) for group in GROUPS],
        "kinds": {summary.kind: _kind_record(summary) for summary in evaluation.kinds},
    }
    text = json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False)
    # numbers of one innermost list side by side: shorter, and readable
    text = re.sub(
        r"\[\n\s*([-+0-9.eE,\snul]+?)\n\s*\]", lambda m: f"[{' '.join(m[1].split())}]", text
    )
    return text + "\n"


def _kind_record(summary: KindSummary) -> dict[str, Any]:
    rows: list[dict[str, Any]] = []
    for i, name in enumerate(summary.rows):
        numbers = {
            key: {part: _plain(getattr(number, part)[i]) for part in ("value", "low", "high")}
            for key, number in summary.numbers.items()
            if not np.isnan(number.value[i]).all()
        }
        rows.append(
            {
                "name": name,
                "role": summary.roles[i],
                "picture_size": summary.picture_sizes[i],
                "missing": summary.missing[i].tolist(),
                "numbers": numbers,
            }
        )
    return {
        "sequences": summary.sequences,
        "subjects": summary.subjects,
        "clips": summary.clips,
        "ssim_size": summary.common_size,
        "best_baseline": summary.best_baseline,
        "rows": rows,
    }


def _plain(values: Any) -> Any:
    """Nested lists of numbers; None for NaN."""
    if isinstance(values, np.ndarray) and values.ndim:
        return [_plain(value) for value in values]
    number = float(values)
    return None if np.isnan(number) else float(f"{number:.{_DIGITS}g}")


def _cells(number: Estimate, place: tuple[int, ...]) -> list[str]:
    parts = (number.value[place], number.low[place], number.high[place])
    return ["" if np.isnan(part) else f"{part:.{_DIGITS}g}" for part in parts]


def _csv(lines: Iterable[Iterable[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()
