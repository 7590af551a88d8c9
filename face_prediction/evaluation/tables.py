"""Numbers to Markdown: Tables I and II and what goes with them, a section for each kind of footage.

Legend: R rows, H horizon, G groups of horizons, K levels of coverage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np

from face_prediction.evaluation.calibration import LEVELS
from face_prediction.evaluation.contestants import PERSISTENCE
from face_prediction.evaluation.published import TABLE_1, TABLE_2
from face_prediction.evaluation.summary import GROUPS, Estimate, KindSummary

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
