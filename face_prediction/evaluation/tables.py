"""Tables I and II of the paper, as printed: measured on its authors' own recordings.

"Improving Robotic Imitation Learning with Predicted Facial Motion Using Transformers", section
IV.B: 100 sequences, five forecast frames of each. What is printed as variances cannot be variances
of errors in these units: a quantity between 0 and 1 with mean 0.017 has none above 0.0167.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.evaluation.calibration import LEVELS
from face_prediction.evaluation.setup import PERSISTENCE
from face_prediction.evaluation.statistics import GROUPS, Estimate, KindSummary
from robo_manip_baselines.runs.files import atomic_file


@dataclass(frozen=True)
class PublishedRow:
    """One column of the paper's Table I; None where it prints a dash."""

    name: str
    mean: tuple[float | None, float | None]
    variance: tuple[float | None, float | None]
    ssim: float


TABLE_1 = (
    PublishedRow("approach 1, images only", (None, None), (None, None), 0.662),
    PublishedRow("approach 2, simple fusion", (0.032, 0.036), (0.061, 0.130), 0.818),
    PublishedRow("approach 3, cross-attention", (0.015, 0.017), (0.013, 0.025), 0.928),
)

#: Approach 3 by frame: rows of Table II by the names that the tables here use.
TABLE_2: dict[str, tuple[float, ...]] = {
    "mean dU": (0.010, 0.019, 0.013, 0.020, 0.014),
    "var dU": (0.010, 0.014, 0.014, 0.013, 0.014),
    "mean dV": (0.013, 0.021, 0.015, 0.017, 0.017),
    "var dV": (0.021, 0.027, 0.026, 0.025, 0.027),
    "SSIM": (0.926, 0.927, 0.928, 0.928, 0.929),
}


#: What a cell without a number holds.
NOTHING = "–"
#: Metrics of Table II: heading, key of `KindSummary.numbers`, axis (U, V; None: there is none).
PER_FRAME: tuple[tuple[str, str, int | None], ...] = (
    ("mean dU", "mean", 0),
    ("var dU", "variance", 0),
    ("mean dV", "mean", 1),
    ("var dV", "variance", 1),
    ("SSIM", "ssim", None),
)
#: Nominal coverage that tables show.
SHOWN_LEVELS = (0.5, 0.9)

Format = Callable[[float], str]


def kind_section(summary: KindSummary, history: int) -> str:
    """Everything about one kind of footage; ``history`` frames are seen, so that 71 is the next."""
    people = "person" if summary.subjects == 1 else "people"
    lines = [
        f"## {summary.kind}: {summary.sequences} sequences of {summary.subjects} {people}, "
        f"{summary.clips} clips",
        "",
    ]
    if summary.subjects < 5:
        lines += [f"With {summary.subjects} {people} the intervals say little about others.", ""]
    lines += [*table_1(summary), *distances(summary, history), *differences(summary, history)]
    lines += [*table_2(summary, history), *coverage(summary, history)]
    lines += exchanged(summary, history)
    return "\n".join(lines)


def table_1(summary: KindSummary) -> list[str]:
    """Table I: mean and variance of abs dU and abs dV, SSIM, NME, and what is missing."""
    numbers = summary.numbers
    is_larger = [size > summary.common_size for size in summary.picture_sizes]
    head = ["", "mean dU", "var dU", "mean dV", "var dV", f"SSIM at {summary.common_size} px"]
    has_pictures = any(
        role == "network" and size
        for role, size in zip(summary.roles, summary.picture_sizes, strict=True)
    )
    if has_pictures:
        head.append("SSIM more than the copy's")
    if any(is_larger):
        head += ["SSIM at own size", "copy at that size"]
    head += ["NME", "missing"]
    rows: list[list[str]] = []
    for i, name in enumerate(summary.rows):
        mean, variance = numbers["pooled_mean"], numbers["pooled_variance"]
        cells = [name]
        for axis in range(2):
            cells += [_with_interval(mean, (i, axis), _error), _error2(variance.value[i, axis])]
        cells.append(_with_interval(numbers["pooled_ssim"], (i,), _ssim))
        if has_pictures:
            is_copy = name == PERSISTENCE
            gain = _with_interval(numbers["pooled_ssim_gain"], (i,), _gain, " to ")
            cells.append("" if is_copy else gain)
        if any(is_larger):
            for key in ("pooled_ssim_own_size", "pooled_ssim_copy_own_size"):
                shown = _with_interval(numbers[key], (i,), _ssim)
                cells.append(f"{shown} at {summary.picture_sizes[i]} px" if is_larger[i] else "")
        cells += [_ssim(numbers["pooled_nme"].value[i]), _missing(summary, i)]
        rows.append(cells)
    for paper in TABLE_1:
        cells = [f"paper, {paper.name} (other data)"]
        for axis in range(2):
            cells += [_plain(paper.mean[axis]), _plain(paper.variance[axis])]
        cells += [f"{_plain(paper.ssim)} at 256 px", *[""] * (len(head) - len(cells) - 1)]
        rows.append(cells)
    return [
        "### Table I: errors of the mouth centre in crops, and SSIM",
        "",
        *_table(head, rows),
        "",
    ]


def distances(summary: KindSummary, history: int) -> list[str]:
    """Distance between forecast and true mouth centre by frame, and skill against persistence."""
    frames = _frames(summary, history)
    size = summary.numbers["distance"]
    rows = [
        [
            name,
            *(_with_interval(size, (i, h), _error) for h in range(len(frames))),
            _with_interval(summary.numbers["pooled_distance"], (i,), _error),
        ]
        for i, name in enumerate(summary.rows)
    ]
    skills = [
        [
            name,
            *(_signed(value) for value in summary.numbers["skill"].value[i]),
            _with_interval(summary.numbers["pooled_skill"], (i,), _signed, " to "),
        ]
        for i, name in enumerate(summary.rows)
        if summary.roles[i] != "reference" and name != PERSISTENCE
    ]
    return [
        "### Distance between forecast and true mouth centre, in crops",
        "",
        *_table(["", *frames, "all"], rows),
        "",
        "### Skill: 1 − mean distance / that of persistence",
        "",
        *_table(["", *frames, "all"], skills),
        "",
    ]


def differences(summary: KindSummary, history: int) -> list[str]:
    """Mean distance less that of the best baseline, in percent of it."""
    spans = [_span(first, last, history) for first, last in GROUPS]
    rows = [
        [
            name,
            *(
                _with_interval(summary.numbers["difference"], (i, g), _percent, " to ")
                for g in range(len(GROUPS))
            ),
        ]
        for i, name in enumerate(summary.rows)
        if summary.roles[i] != "reference" and name != summary.best_baseline
    ]
    return [
        f"### Mean distance against {summary.best_baseline}, the best baseline at frames "
        f"{spans[1]}",
        "",
        *_table(["", *(f"frames {span}" for span in spans)], rows),
        "",
    ]


def table_2(summary: KindSummary, history: int) -> list[str]:
    """Table II: the metrics of Table I for each forecast frame."""
    frames = _frames(summary, history)
    lines = ["### Table II: by forecast frame", ""]
    for heading, key, axis in PER_FRAME:
        number = summary.numbers[key]
        values = number.value if axis is None else number.value[..., axis]
        form = {"mean": _error, "variance": _error2, "ssim": _ssim}[key]
        rows = [
            [name, *map(form, values[i])]
            for i, name in enumerate(summary.rows)
            if not np.isnan(values[i]).all()
        ]
        if len(frames) == len(TABLE_2[heading]):
            rows.append(["paper, approach 3 (other data)", *map(_plain, TABLE_2[heading])])
        lines += [*_table([heading, *frames], rows), ""]
    return lines


def coverage(summary: KindSummary, history: int) -> list[str]:
    """How much intervals of 50 and 90 % hold."""
    places = [i for i, has in enumerate(summary.has_intervals) if has]
    if not places:
        return []
    frames = _frames(summary, history)
    rows: list[list[str]] = []
    for i in places:
        for level in SHOWN_LEVELS:
            k = LEVELS.index(level)
            values = summary.numbers["coverage"].value[i, :, k]
            pooled = _with_interval(summary.numbers["pooled_coverage"], (i, k), _share)
            rows.append([f"{summary.rows[i]}, {level:.0%}", *map(_share, values), pooled])
    return [
        "### Coverage of the mouth centre's intervals, U and V together, in percent",
        "",
        *_table(["", *frames, "all"], rows),
        "",
    ]


def exchanged(summary: KindSummary, history: int) -> list[str]:
    """How much worse networks get when they are shown other sequences' pictures."""
    number = summary.numbers["exchanged"]
    places = [i for i in range(len(summary.rows)) if not np.isnan(number.value[i]).all()]
    if not places:
        return []
    spans = [f"frames {_span(first, last, history)}" for first, last in GROUPS]
    rows = [
        [
            summary.rows[i],
            *(_with_interval(number, (i, g), _percent, " to ") for g in range(len(GROUPS) + 1)),
        ]
        for i in places
    ]
    return [
        "### Mean distance with another sequence's pictures against with its own",
        "",
        *_table(["", *spans, "all"], rows),
        "",
    ]


def _frames(summary: KindSummary, history: int) -> list[str]:
    return [str(history + h + 1) for h in range(summary.missing.shape[1])]


def _span(first: int, last: int, history: int) -> str:
    return f"{history + first}–{history + last}"


def _missing(summary: KindSummary, row: int) -> str:
    missing = int(summary.missing[row].sum())
    return f"{missing} of {summary.sequences * summary.missing.shape[1]}" if missing else "0"


def _with_interval(
    number: Estimate, place: tuple[int, ...], form: Format, between: str = "–"
) -> str:
    value, low, high = (part[place] for part in (number.value, number.low, number.high))
    if np.isnan(value):
        return NOTHING
    return f"{form(value)} ({form(low)}{between}{form(high)})"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [_line(head), "|" + "---|" * len(head)]
    return lines + [_line(row) for row in rows]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _shown(pattern: str, value: float) -> str:
    return NOTHING if np.isnan(value) else pattern.format(value)


_error = partial(_shown, "{:.4f}")
_error2 = partial(_shown, "{:.1e}")
_ssim = partial(_shown, "{:.3f}")
_signed = partial(_shown, "{:+.2f}")
_percent = partial(_shown, "{:+.1f} %")
_gain = partial(_shown, "{:+.3f}")


def _share(value: float) -> str:
    return _shown("{:.1f}", 100 * value)


def _plain(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.3f}"


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
        with atomic_file(folder / name) as temporary:
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
            key: {
                part: _plain_results(getattr(number, part)[i]) for part in ("value", "low", "high")
            }
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


def _plain_results(values: Any) -> Any:
    """Nested lists of numbers; None for NaN."""
    if isinstance(values, np.ndarray) and values.ndim:
        return [_plain_results(value) for value in values]
    number = float(values)
    return None if np.isnan(number) else float(f"{number:.{_DIGITS}g}")


def _cells(number: Estimate, place: tuple[int, ...]) -> list[str]:
    parts = (number.value[place], number.low[place], number.high[place])
    return ["" if np.isnan(part) else f"{part:.{_DIGITS}g}" for part in parts]


def _csv(lines: Iterable[Iterable[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()
