"""What kind of footage a clip is: errors of different kinds are reported apart."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from face_prediction.errors import RequestError

#: natural: people who talk or look about, mixed. head_motion: clear or deliberate motion of the
#: head. grid: the GRID corpus, sentences read with hardly any motion of the head.
KINDS = ("natural", "head_motion", "grid")
#: Words of a table's column `what` that mean head_motion.
HEAD_MOTION_WORDS = ("nod", "nodding", "turn", "turning", "tilt", "tilting", "large motion")


def kind_of(clip: str, kind: str = "", what: str = "") -> str:
    """The kind of a clip by its row's columns ``kind`` and ``what``, where they are filled in.

    ``kind`` counts as it stands; then a name that begins with ``grid`` is grid; then the words of
    `HEAD_MOTION_WORDS` in ``what`` decide.

    Raises:
        RequestError: ``kind`` is none of `KINDS`.
    """
    if kind:
        if kind not in KINDS:
            raise RequestError(f"kind '{kind}' of clip '{clip}'; one of {', '.join(KINDS)}")
        return kind
    if clip.lower().startswith("grid"):
        return "grid"
    words = "|".join(HEAD_MOTION_WORDS)
    return "head_motion" if re.search(rf"\b({words})\b", what.lower()) else "natural"


def read_kinds(path: Path) -> dict[str, str]:
    """Clip name (without suffix) to kind, from an attribution table (``.csv`` or Markdown).

    Raises:
        RequestError: the file cannot be read, or a kind is none of `KINDS`.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"--attribution {path}: cannot be read ({error})") from None
    if path.suffix == ".csv":
        rows = list(csv.reader(lines))
    else:
        tables = [line.strip() for line in lines if line.strip().startswith("|")]
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in tables]
    header: list[str] | None = None
    kinds: dict[str, str] = {}
    for cells in rows:
        lower = [cell.lower() for cell in cells]
        if {"clip", "subject"} <= set(lower):
            header = lower
        elif header is not None and len(cells) == len(header) and set("".join(cells)) - set("-: "):
            row = dict(zip(header, cells, strict=True))
            clip = Path(row["clip"]).stem
            try:
                kinds[clip] = kind_of(clip, row.get("kind", ""), row.get("what", ""))
            except RequestError as error:
                raise RequestError(f"--attribution {path}: {error}") from None
    return kinds
