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
from face_prediction.evaluation.scoring import LEVELS
from face_prediction.evaluation.setup import PERSISTENCE
from face_prediction.evaluation.statistics import GROUPS, KindSummary
from robo_manip_baselines.runs.documents import convert, read_json
from robo_manip_baselines.runs.files import FolderKind, write_text
from robo_manip_baselines.runs.markdown import markdown_table

Format = Callable[[float], str]
Column = tuple[str, tuple[Any, ...], Format, str | None]
"""Cells of a Markdown table: key of `KindSummary.numbers`, place after the row's, format, and what
stands between the bounds of the interval (None: without the interval)."""

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
_error, _variance, _ssim = "{:.4f}".format, "{:.1e}".format, "{:.3f}".format
_skill, _percent, _gain = "{:+.2f}".format, "{:+.1f} %".format, "{:+.3f}".format
PER_FRAME: tuple[tuple[str, str, tuple[Any, ...], Format], ...] = (
    ("mean dU", "mean", (..., 0), _error),
    ("var dU", "variance", (..., 0), _variance),
    ("mean dV", "mean", (..., 1), _error),
    ("var dV", "variance", (..., 1), _variance),
    ("SSIM", "ssim", (), _ssim),
)
"""Metrics of Table II: heading, key of `KindSummary.numbers`, axis U or V, format."""
TABULATED_LEVELS = (0.5, 0.9)  # nominal coverages
SPLITS = {
    "person": "Everybody is forecast by predictors that never saw the person.",
    "sequence": """Split by sequence, as the paper's: people in these windows of 75 frames were
trained on, too, in windows that share no frame with them.""",
}
FOLDS = {"person": "Folds", "sequence": "Parts"}
INTRODUCTION = """Errors are of the mouth centre (mean of the lip landmarks), as shares of the crop;
a frame without a forecast is missing and enters no mean. In brackets: 95 % intervals from
resampling people, and sequences within each. Kinds of footage are apart, because pooling flatters.
Variances are of the frames, divided by their number. NME: mean distance over all landmarks /
distance between the outer eye corners. SSIM: scikit-image, Gaussian window of 1.5 pixels, in
colour. All images are compared at one size, the smallest that any row makes, larger ones brought
there by averaging areas; persistence copies the last image. Rows of the paper are its printed
figures, from its own recordings."""

RESULTS = "results.json"
WRITTEN_NAMES = {"shuffled_images": "exchanged"}
"""Keys of `KindSummary.numbers` that ``results.json`` has under the names of earlier releases."""

_NOTHING = "–"
_DIGITS = 9  # significant digits in CSV and JSON: more than the bootstrap is good for


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


def write_evaluation_report(
    folder: Path, report: EvaluationReport, earlier: Sequence[str] = ()
) -> list[Path]:
    """Write ``results.json`` and the tables, each whole or not at all.

    Args:
        folder: to write to.
        report: on what was evaluated.
        earlier: files of an earlier evaluation, which stay listed until they are removed.

    Returns:
        The files beside ``results.json``.

    Raises:
        RequestError: the folder cannot be written to.
    """
    # first: by it the folder is known as ours
    write_text(folder / RESULTS, results_json(report, earlier))
    texts = {
        "tables.md": markdown_text(report),
        "table1.csv": _table_1_csv(report),
        "table2.csv": _table_2_csv(report),
    }
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]


def earlier_files(folder: Path) -> list[str]:
    """Names of the files that an evaluation in ``folder`` has written beside ``results.json``.

    None are known of evaluations of earlier releases, which had no such list.

    Raises:
        RequestError: the list is damaged.
    """
    path = folder / RESULTS
    files = read_json(path).get("files", []) if path.exists() else []
    return convert(files, list[str], f"'{path}': files")


def list_files(
    folder: Path, report: EvaluationReport, written: Iterable[Path], earlier: Iterable[str]
) -> None:
    """Remove the files of an ``earlier`` evaluation that were not ``written`` again; list these."""
    names = {path.name for path in written}
    for name in earlier:
        path = folder / name
        if name not in names and path.parent == folder and path.is_file():
            path.unlink()
    write_text(folder / RESULTS, results_json(report, sorted(names)))


def _is_evaluation(folder: Path) -> bool:
    path = folder / RESULTS
    return path.exists() and read_json(path).get("schema") == SCHEMA


EVALUATION = FolderKind("evaluation of face-prediction evaluate", _is_evaluation)


def markdown_text(report: EvaluationReport) -> str:
    """``tables.md``."""
    folds, split = ", ".join(map(str, report.folds)), report.provenance["split"]["by"]
    parts = [
        "# Forecasts of faces, evaluated",
        f"{SPLITS[split]} {INTRODUCTION}",
        f"{FOLDS[split]} reported on: {folds}. Every row is on the same sequences.",
    ]
    notes = report.provenance.get("notes", [])
    if notes:
        parts.append("\n".join(f"- {note}" for note in notes))
    for summary in report.kinds:
        parts += _kind_sections(summary, report.history)
    return "\n\n".join(parts) + "\n"


def markdown_table_1(summary: KindSummary) -> str:
    """Table I: mean and variance of abs dU and abs dV, SSIM, NME, and what is missing."""
    makes_images = any(row.role == "network" and row.image_size for row in summary.rows)
    makes_larger = any(row.image_size > summary.common_size for row in summary.rows)
    head = ["", "mean dU", "var dU", "mean dV", "var dV", f"SSIM at {summary.common_size} px"]
    head += ["SSIM more than the copy's"] if makes_images else []
    head += ["SSIM at own size", "copy at that size"] if makes_larger else []
    head += ["NME", "missing"]
    errors: list[Column] = []
    for axis in range(2):
        errors.append(("pooled_mean", (axis,), _error, "–"))
        errors.append(("pooled_variance", (axis,), _variance, None))
    rows: list[list[str]] = []
    for i, row in enumerate(summary.rows):
        cells = [row.name, *_cells(summary, i, [*errors, ("pooled_ssim", (), _ssim, "–")])]
        if makes_images:
            gain = _cells(summary, i, [("pooled_ssim_gain", (), _gain, " to ")])
            cells += [""] if row.name == PERSISTENCE else gain
        if makes_larger:
            for key in ("pooled_ssim_own_size", "pooled_ssim_copy_own_size"):
                (ssim,) = _cells(summary, i, [(key, (), _ssim, "–")])
                is_larger = row.image_size > summary.common_size
                cells.append(f"{ssim} at {row.image_size} px" if is_larger else "")
        cells += _cells(summary, i, [("pooled_nme", (), _ssim, None)])
        missing, frames = int(row.missing.sum()), summary.sequences * summary.horizon
        rows.append([*cells, f"{missing} of {frames}" if missing else "0"])
    for name, values in PAPER_TABLE_1:
        printed = [_NOTHING if value is None else f"{value:.3f}" for value in values]
        cells = [f"paper, {name} (other data)", *printed[:-1], f"{printed[-1]} at 256 px"]
        rows.append(cells + [""] * (len(head) - len(cells)))
    return markdown_table(head, rows)


def results_json(report: EvaluationReport, files: Sequence[str] = ()) -> str:
    """``results.json``: every number, the provenance, and the names of the ``files`` beside it."""
    record = {"schema": SCHEMA, "version": VERSION, **report.provenance}
    record |= {"files": files, "history": report.history, "folds": report.folds}
    record |= {"coverage_levels": LEVELS, "horizon_groups": GROUPS}
    kinds = {summary.kind: _kind_record(summary) for summary in report.kinds}
    return compact_json(record | {"kinds": kinds})


def _kind_sections(summary: KindSummary, history: int) -> list[str]:
    """Sections on one kind of footage; ``history`` frames are seen, so that 71 is the next."""
    people = "person" if summary.subjects == 1 else "people"
    rows, best = dict(enumerate(summary.rows)), summary.best_baseline
    frames = [str(history + h + 1) for h in range(summary.horizon)]
    spans = [f"{history + first}–{history + last}" for first, last in GROUPS]
    groups = [f"frames {span}" for span in spans]
    by_frame = ["", *frames, "all"]

    def table(head: Sequence[str], chosen: Iterable[int], *columns: Column) -> str:
        cells = ([rows[i].name, *_cells(summary, i, columns)] for i in chosen)
        return markdown_table(head, cells)

    forecasts = [i for i, row in rows.items() if row.role != "reference"]
    count = f"{summary.sequences} sequences of {summary.subjects} {people}"
    parts = [f"## {summary.kind}: {count}, {summary.clips} clips"]
    if summary.subjects < 5:
        parts.append(f"With {summary.subjects} {people} the intervals say little about others.")
    parts += [
        "### Table I: errors of the mouth centre in crops, and SSIM",
        markdown_table_1(summary),
        "### Distance between forecast and true mouth centre, in crops",
        table(by_frame, rows, ("distance", (), _error, "–"), ("pooled_distance", (), _error, "–")),
        "### Skill: 1 − mean distance / that of persistence",
        table(
            by_frame,
            [i for i in forecasts if rows[i].name != PERSISTENCE],
            *(("skill", (), _skill, None), ("pooled_skill", (), _skill, " to ")),
        ),
        f"### Mean distance against {best}, the best baseline at frames {spans[1]}",
        table(
            ["", *groups],
            [i for i in forecasts if rows[i].name != best],
            ("difference", (), _percent, " to "),
        ),
        "### Table II: by forecast frame",
    ]
    for heading, key, axis, form in PER_FRAME:
        columns: list[Column] = [(key, axis, form, None)]
        cells = [[row.name, *_cells(summary, i, columns)] for i, row in rows.items()]
        cells = [line for line in cells if set(line[1:]) != {_NOTHING}]
        if len(frames) == len(PAPER_TABLE_2[heading]):
            cells.append(["paper, approach 3 (other data)", *map(_ssim, PAPER_TABLE_2[heading])])
        parts.append(markdown_table([heading, *frames], cells))
    cells = []
    for i, row in rows.items():
        for level in TABULATED_LEVELS if row.has_intervals else ():
            k = LEVELS.index(level)
            columns = [("coverage", (..., k), _share, None), ("pooled_coverage", (k,), _share, "–")]
            cells.append([f"{row.name}, {level:.0%}", *_cells(summary, i, columns)])
    if cells:
        parts.append("### Coverage of the mouth centre's intervals, U and V together, in percent")
        parts.append(markdown_table(by_frame, cells))
    change: Column = ("shuffled_images", (), _percent, " to ")
    shuffled = [i for i in rows if not np.isnan(summary.numbers[change[0]].value[i]).all()]
    if shuffled:
        parts.append("### Mean distance with another sequence's images against with its own")
        parts.append(table(["", *groups, "all"], shuffled, change))
    return parts


def _cells(summary: KindSummary, row: int, columns: Iterable[Column]) -> list[str]:
    """Cells of one row."""
    cells: list[str] = []
    for key, place, form, between in columns:
        for value, *bounds in _bounded(summary, key, (row, *place)):
            cell = _NOTHING if np.isnan(value) else form(value)
            if between is not None and cell != _NOTHING:
                cell += f" ({between.join(map(form, bounds))})"
            cells.append(cell)
    return cells


def _bounded(summary: KindSummary, key: str, place: tuple[Any, ...]) -> np.ndarray:
    """Values with their bounds (n, 3)."""
    number = summary.numbers[key]
    parts = (number.value, number.low, number.high)
    return np.stack([np.ravel(part[place]) for part in parts], axis=-1)


def _share(value: float) -> str:
    return f"{100 * value:.1f}"


def _table_1_csv(report: EvaluationReport) -> str:
    """A line for each kind of footage and row; the bounds of intervals in columns of their own."""
    columns: list[tuple[str, str, tuple[int, ...]]] = []
    for axis, name in enumerate(("du", "dv")):
        columns.append((f"mean_{name}", "pooled_mean", (axis,)))
        columns.append((f"var_{name}", "pooled_variance", (axis,)))
    for name in ("ssim", "ssim_own_size", "ssim_copy_own_size", "nme", "distance", "skill"):
        columns.append((name, f"pooled_{name}", ()))
    head = ["kind", "row", "role", "sequences", "subjects", "missing", "picture_size", "ssim_size"]
    head += [f"{name}{end}" for name, _, _ in columns for end in ("", "_low", "_high")]
    lines: list[list[Any]] = [head]
    for summary in report.kinds:
        for i, row in enumerate(summary.rows):
            line = [summary.kind, row.name, row.role, summary.sequences, summary.subjects]
            line += [row.missing.sum(), row.image_size or "", summary.common_size]
            for _, key, place in columns:
                line += _csv_cells(summary, key, (i, *place))
            lines.append(line)
    for name, values in PAPER_TABLE_1:
        line = ["paper (other data)", name, "paper", 100, "", "", 256, 256]
        for value in values:
            line += [value, "", ""]
        lines.append(line + [""] * (len(head) - len(line)))
    return _csv(lines)


def _table_2_csv(report: EvaluationReport) -> str:
    """A line for each kind, row, metric and frame."""
    lines: list[list[Any]] = [["kind", "row", "role", "metric", "frame", "value", "low", "high"]]
    metrics = [(heading, key, axis) for heading, key, axis, _ in PER_FRAME]
    metrics += [("distance", "distance", ()), ("skill", "skill", ()), ("NME", "nme", ())]
    for summary in report.kinds:
        for i, row in enumerate(summary.rows):
            for heading, key, axis in metrics:
                cells = _csv_cells(summary, key, (i, *axis))
                for h in range(summary.horizon):
                    line = [summary.kind, row.name, row.role, heading, report.history + h + 1]
                    lines.append(line + cells[3 * h : 3 * h + 3])
    for heading, values in PAPER_TABLE_2.items():
        for frame, value in enumerate(values, start=71):
            line = ["paper (other data)", "approach 3, cross-attention", "paper", heading, frame]
            lines.append([*line, value, "", ""])
    return _csv(lines)


def _csv_cells(summary: KindSummary, key: str, place: tuple[Any, ...]) -> list[str]:
    numbers = _bounded(summary, key, place).ravel()
    return ["" if np.isnan(number) else f"{number:.{_DIGITS}g}" for number in numbers]


def _csv(lines: Iterable[Iterable[Any]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()


def _kind_record(summary: KindSummary) -> dict[str, Any]:
    rows: list[dict[str, Any]] = []
    for i, row in enumerate(summary.rows):
        numbers = {
            WRITTEN_NAMES.get(key, key): {
                part: _rounded(values[i].tolist()) for part, values in vars(number).items()
            }
            for key, number in summary.numbers.items()
            if not np.isnan(number.value[i]).all()
        }
        record = {"name": row.name, "role": row.role, "picture_size": row.image_size}
        rows.append(record | {"missing": row.missing.tolist(), "numbers": numbers})
    return {
        "sequences": summary.sequences,
        "subjects": summary.subjects,
        "clips": summary.clips,
        "ssim_size": summary.common_size,
        "best_baseline": summary.best_baseline,
        "rows": rows,
    }


def _rounded(values: Any) -> Any:
    """Nested lists of rounded numbers; None for NaN."""
    if isinstance(values, list):
        return [_rounded(value) for value in values]
    return None if np.isnan(values) else float(f"{values:.{_DIGITS}g}")
