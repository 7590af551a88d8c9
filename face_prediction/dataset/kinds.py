"""What kind of footage a clip is: errors of different kinds are reported apart."""

from __future__ import annotations

import re

from face_prediction.attribution import Attribution
from face_prediction.errors import RequestError

#: natural: people who talk or look about, mixed. head_motion: clear or deliberate motion of the
#: head. grid: the GRID corpus, sentences read with hardly any motion of the head.
KINDS = ("natural", "head_motion", "grid")
#: Words of a table's column `what` that mean head_motion.
HEAD_MOTION_WORDS = ("nod", "nodding", "turn", "turning", "tilt", "tilting", "large motion")


def kind_of(row: Attribution) -> str:
    """The kind of a clip by its row in the table of attributions.

    ``kind`` counts as it stands; then a name that begins with ``grid`` is grid; then the words of
    `HEAD_MOTION_WORDS` in ``what`` decide.

    Raises:
        RequestError: ``kind`` is none of `KINDS`.
    """
    if row.kind:
        if row.kind not in KINDS:
            raise RequestError(f"kind '{row.kind}' of clip '{row.clip}'; one of {', '.join(KINDS)}")
        return row.kind
    if row.clip.lower().startswith("grid"):
        return "grid"
    words = "|".join(HEAD_MOTION_WORDS)
    return "head_motion" if re.search(rf"\b({words})\b", row.what.lower()) else "natural"
