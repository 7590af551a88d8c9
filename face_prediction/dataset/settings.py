"""What shapes a sequence: one frozen record, kept in every file that it made."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from face_prediction.motion.library import Attribution
from face_prediction.motion.motion import QualityLimits
from robo_manip_baselines.runs.errors import RequestError

CropFrom = Literal["history", "sequence"]


@dataclass(frozen=True)
class SequenceSettings:
    """How a clip is cut into sequences; recorded with them.

    Raises:
        RequestError: a value is out of its range; the message names the option.
    """

    #: Frames that a predictor is shown, and frames that it predicts (paper, IV.B).
    history: int = 70
    future: int = 5
    #: Frames per second of the sequences (paper, IV.B).
    fps: float = 30.0
    #: Frames between the starts of neighbouring sequences.
    stride: int = 15
    #: Room left on each side of the face, in lengths of the longer side of the box around it.
    margin: float = 0.1
    #: Frames that the crop is laid around. ``sequence`` makes sure that the face stays inside, but
    #: tells where it is going: see docs/face_dataset.md.
    crop_from: CropFrom = "history"
    #: Side of the pictures in pixels (paper, IV.A).
    crop_size: int = 256
    #: Of the JPEG pictures, 1...100.
    quality: int = 90
    #: What counts as a jump of the detector.
    limits: QualityLimits = field(default_factory=QualityLimits)

    def __post_init__(self) -> None:
        for name, low, high in (
            ("history", 1, 10_000),
            ("future", 1, 10_000),
            ("stride", 1, 1_000_000),
            ("crop_size", 16, 4096),
            ("quality", 1, 100),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise RequestError(f"--{name} {value}: between {low} and {high}")
        if not 0.0 < self.fps <= 1000.0:
            raise RequestError(f"--fps {self.fps}: more than 0, up to 1000")
        if not (math.isfinite(self.margin) and 0.0 <= self.margin <= 2.0):
            raise RequestError(f"--margin {self.margin}: between 0 and 2")
        if self.crop_from not in ("history", "sequence"):
            raise RequestError(f"--crop_from {self.crop_from}: history or sequence")

    @property
    def length(self) -> int:
        """Frames of a sequence."""
        return self.history + self.future

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and text, what `from_json` takes."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> SequenceSettings:
        """Undo `to_json`.

        Raises:
            RequestError: ``data`` holds other keys or values that are no settings.
        """
        wanted = {item.name for item in fields(cls)}
        if not isinstance(data, Mapping) or set(data) != wanted:
            raise RequestError(f"settings need the keys {', '.join(sorted(wanted))}")
        try:
            return cls(**{**data, "limits": QualityLimits(**data["limits"])})
        except TypeError as error:
            raise RequestError(f"settings are not as expected: {error}") from None


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
