"""The closing tables of ``build-dataset``: what moves in it, by kind of footage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from face_prediction.dataset.kinds import KINDS
from face_prediction.dataset.manifest import ClipEntry, SequenceRow
from face_prediction.dataset.sequences import REASONS

#: column heading, fact, factor, decimals
_MEDIANS = (
    ("mouth range u, v crop", ("mouth_range_u", "mouth_range_v"), 1.0, 3),
    ("mouth range x, y mm", ("mouth_range_x", "mouth_range_y"), 1000.0, 1),
    ("head deg", ("head_rotation_range",), 1.0, 1),
    ("mouth opening mm", ("mouth_opening_range",), 1000.0, 1),
    ("interpolated %", ("interpolated_share",), 100.0, 0),
)


def kind_table(clips: Sequence[ClipEntry], rows: Sequence[SequenceRow]) -> str:
    """Markdown: per kind of footage, counts and the medians of the facts."""
    names = [name.replace("_", " ") for name in REASONS]
    head = ["footage", "subjects", "clips", "too short", "sequences", *names]
    head += [heading for heading, *_ in _MEDIANS]
    lines = [_line(head), _line(["---"] * len(head))]
    for kind in KINDS:
        of_kind = [clip for clip in clips if clip.kind == kind]
        if of_kind:
            part = [row for row in rows if row.kind == kind]
            lines.append(_line([kind, *_counts(of_kind), *_medians(part)]))
    lines.append(_line(["all", *_counts(clips), *_medians(rows)]))
    return "\n".join(lines)


def fold_table(clips: Sequence[ClipEntry], folds: int) -> str:
    """Markdown: per fold, subjects and sequences of each kind."""
    kinds = [kind for kind in KINDS if any(clip.kind == kind for clip in clips)]
    lines = [_line(["fold", "subjects", "sequences", *kinds])]
    lines.append(_line(["---"] * (3 + len(kinds))))
    for fold in range(folds):
        part = [clip for clip in clips if clip.fold == fold]
        of_kind = [sum(c.sequences for c in part if c.kind == kind) for kind in kinds]
        subjects = len({clip.subject for clip in part})
        lines.append(_line([str(fold), str(subjects), str(sum(of_kind)), *map(str, of_kind)]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _counts(clips: Sequence[ClipEntry]) -> list[str]:
    numbers = [
        len({clip.subject for clip in clips if clip.sequences}),
        sum(clip.sequences > 0 for clip in clips),
        sum(clip.candidates == 0 for clip in clips),
        sum(clip.sequences for clip in clips),
        *(sum(clip.dropped.get(reason, 0) for clip in clips) for reason in REASONS),
    ]
    return [str(number) for number in numbers]


def _medians(rows: Sequence[SequenceRow]) -> list[str]:
    if not rows:
        return ["–"] * len(_MEDIANS)
    return [
        " ".join(
            f"{factor * float(np.median([row.facts[fact] for row in rows])):.{digits}f}"
            for fact in facts
        )
        for _, facts, factor, digits in _MEDIANS
    ]
