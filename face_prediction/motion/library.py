"""Who is in a clip, where it is from, and whether numbers measured on it may be given away."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.motion.motion import ClipMotion
from face_prediction.tracking.geometry import continuous_quaternions
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import Arrays, read_npz, require_array, write_npz

COLUMNS = ("clip", "subject", "ship", "licence", "source")


@dataclass(frozen=True)
class Attribution:
    """One clip's row: its name without suffix, its person, and the terms it comes under."""

    clip: str
    subject: str
    #: whether numbers measured on the clip may be redistributed
    ship: bool
    licence: str
    source: str
    #: kind of footage, from the optional column ``kind``
    kind: str = ""
    #: what is to be seen, from the optional column ``what``
    what: str = ""

    def record(self) -> dict[str, str]:
        """What is kept in a library: everything but the clip's name and ``ship``."""
        return {k: v for k, v in asdict(self).items() if k in ("subject", "licence", "source")}


def read_attributions(path: Path) -> dict[str, Attribution]:
    """Rows of a table with the columns clip, subject, ship (yes or no), licence and source.

    Columns ``kind`` and ``what`` are read where there are any. The file is a ``.csv`` with a header
    line, or a Markdown file with such a table in it; other columns, text and tables are passed
    over.

    Raises:
        RequestError: the file cannot be read, has no such table, or a row is incomplete.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"--attribution {path}: cannot be read ({error})") from None
    lines = text.splitlines()
    rows = list(csv.reader(lines)) if path.suffix == ".csv" else _markdown_rows(lines)
    header: list[str] | None = None
    attributions: dict[str, Attribution] = {}
    for cells in rows:
        if set(COLUMNS) <= {cell.lower() for cell in cells}:
            header = [cell.lower() for cell in cells]
        elif header is not None and len(cells) == len(header):
            row = dict(zip(header, cells, strict=True))
            attribution = _attribution(path, row)
            if attribution.clip in attributions:
                raise RequestError(f"--attribution {path}: two rows for '{attribution.clip}'")
            attributions[attribution.clip] = attribution
        elif header is not None and cells:
            raise RequestError(
                f"--attribution {path}: {len(cells)} cells for {len(header)} columns in the row "
                f"of '{cells[0]}'"
            )
    if header is None:
        raise RequestError(
            f"--attribution {path}: no table with the columns {', '.join(COLUMNS)} in it"
        )
    return attributions


def _attribution(path: Path, row: dict[str, str]) -> Attribution:
    missing = [name for name in COLUMNS if not row[name]]
    if missing:
        raise RequestError(f"--attribution {path}: row '{row['clip']}' has no {', '.join(missing)}")
    ship = row["ship"].lower()
    if ship not in ("yes", "no"):
        raise RequestError(
            f"--attribution {path}: ship '{row['ship']}' in the row of '{row['clip']}'; yes or no"
        )
    clip = Path(row["clip"]).stem
    return Attribution(
        clip,
        row["subject"],
        ship == "yes",
        row["licence"],
        row["source"],
        kind=row.get("kind", ""),
        what=row.get("what", ""),
    )


def _markdown_rows(lines: list[str]) -> list[list[str]]:
    """Cells of the table lines that have the wanted columns; other tables are skipped."""
    rows: list[list[str]] = []
    inside = False
    for line in lines:
        text = line.strip()
        if not text.startswith("|"):
            inside = False
            continue
        cells = [cell.strip() for cell in text.strip("|").split("|")]
        if set(COLUMNS) <= {cell.lower() for cell in cells}:
            inside = True
        elif set("".join(cells)) <= set("-: "):
            continue  # the rule below the header
        if inside:
            rows.append(cells)
    return rows


SCHEMA = "recorded_face_motion"
VERSION = 1


@dataclass(frozen=True)
class MotionLibrary:
    """Runs of recorded face motion. Camera frame: x right in the image, y up, z to the camera."""

    fps: float
    time: np.ndarray  # (N,) s from the start of the run
    mouth: np.ndarray  # (N, 3) float32 m, mouth centre in the camera frame
    orientation: np.ndarray  # (N, 4) float32 wxyz, camera from head
    jaw: np.ndarray  # (N,) float32 m between the inner lips
    run_start: np.ndarray  # (R,) int64, first frame of the run
    run_length: np.ndarray  # (R,) int64 frames
    run_clip: np.ndarray  # (R,) names
    run_subject: np.ndarray  # (R,) names
    metadata: dict[str, Any]
    #: (N, H, 3) float32 m: where the mouth was forecast to be 1 ... H frames after each frame, in
    #: the frame of ``mouth``; None: nothing was forecast
    predicted_mouth: np.ndarray | None = None

    @property
    def seconds(self) -> float:
        """Continuous motion in the library: the time from first to last frame, summed over runs."""
        return float((self.run_length - 1).sum() / self.fps)

    def run(self, index: int) -> slice:
        """The frames of one run."""
        start = int(self.run_start[index])
        return slice(start, start + int(self.run_length[index]))


def build_library(
    clips: Sequence[tuple[str, str, ClipMotion]], metadata: dict[str, Any]
) -> MotionLibrary:
    """Put the runs of (clip, subject, motion) one after another.

    Raises:
        RequestError: no clip has a run, or the clips differ in rate.
    """
    parts = [
        (clip, subject, motion, slice(start, stop))
        for clip, subject, motion in clips
        for start, stop in motion.runs
    ]
    if not parts:
        raise RequestError("no run is long enough and within reach; nothing to write")
    rates = {motion.fps for _, _, motion in clips}
    if len(rates) > 1:
        raise RequestError(
            f"tracks of different rates {sorted(rates)}; extract them all with one --fps"
        )
    fps = rates.pop()
    lengths = np.array([part.stop - part.start for *_, part in parts], dtype=np.int64)
    return MotionLibrary(
        fps=fps,
        time=np.concatenate([np.arange(n) / fps for n in lengths]),
        mouth=np.concatenate([m.mouth[part] for _, _, m, part in parts]).astype(np.float32),
        orientation=np.concatenate(
            [continuous_quaternions(m.orientation[part]) for _, _, m, part in parts]
        ).astype(np.float32),
        jaw=np.concatenate([m.jaw[part] for _, _, m, part in parts]).astype(np.float32),
        run_start=np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
        run_length=lengths,
        run_clip=np.array([clip for clip, *_ in parts]),
        run_subject=np.array([subject for _, subject, *_ in parts]),
        metadata=metadata,
    )


def save_library(path: Path, library: MotionLibrary) -> None:
    """Write ``library`` to ``path``, whole or not at all."""
    arrays = {
        "schema": np.array(SCHEMA),
        "version": np.array(VERSION),
        "fps": np.array(library.fps, dtype=np.float64),
        "time": library.time,
        "mouth": library.mouth,
        "orientation": library.orientation,
        "jaw": library.jaw,
        "run_start": library.run_start,
        "run_length": library.run_length,
        "run_clip": library.run_clip,
        "run_subject": library.run_subject,
        "metadata": np.array(json.dumps(library.metadata, sort_keys=True)),
    }
    if library.predicted_mouth is not None:
        arrays["predicted_mouth"] = library.predicted_mouth
    write_npz(path, arrays)


def load_library(path: Path) -> MotionLibrary:
    """Read and check the library at ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema, or breaks a promise; the
            message names the file and the key.
    """
    arrays = read_npz(path, SCHEMA, VERSION)
    time = require_array(path, arrays, "time", (None,), "f")
    run_start = require_array(path, arrays, "run_start", (None,), "iu")
    frames, runs = len(time), len(run_start)
    try:
        metadata = json.loads(str(require_array(path, arrays, "metadata", (), "U")))
    except json.JSONDecodeError:
        raise RequestError(f"{path}: 'metadata' is not JSON; make the file again") from None
    library = MotionLibrary(
        fps=float(require_array(path, arrays, "fps", (), "f")),
        time=time,
        mouth=require_array(path, arrays, "mouth", (frames, 3), "f"),
        orientation=require_array(path, arrays, "orientation", (frames, 4), "f"),
        jaw=require_array(path, arrays, "jaw", (frames,), "f"),
        run_start=run_start,
        run_length=require_array(path, arrays, "run_length", (runs,), "iu"),
        run_clip=require_array(path, arrays, "run_clip", (runs,), "U"),
        run_subject=require_array(path, arrays, "run_subject", (runs,), "U"),
        metadata=metadata,
        predicted_mouth=(
            require_array(path, arrays, "predicted_mouth", (frames, None, 3), "f")
            if "predicted_mouth" in arrays
            else None
        ),
    )
    _check(path, arrays, library)
    return library


def _check(path: Path, arrays: Arrays, library: MotionLibrary) -> None:
    for key in ("fps", "time", "mouth", "orientation", "jaw", "predicted_mouth"):
        if key in arrays and not np.all(np.isfinite(arrays[key])):
            raise RequestError(f"{path}: '{key}' holds NaN or infinity")
    ends = library.run_start + library.run_length
    joined = np.concatenate([[0], ends])
    if (
        len(library.run_start) == 0
        or library.fps <= 0
        or np.any(library.run_length < 2)
        or not np.array_equal(joined[:-1], library.run_start)
        or joined[-1] != len(library.time)
    ):
        raise RequestError(f"{path}: 'run_start' and 'run_length' do not divide the frames")
    norms = np.linalg.norm(library.orientation.astype(float), axis=1)
    if np.any(np.abs(norms - 1) > 1e-5):  # float32 quaternions are unit to 1e-7
        raise RequestError(f"{path}: 'orientation' holds quaternions that are not of unit length")
