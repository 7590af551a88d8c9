"""The library of recorded face motion: clips that may be redistributed, their runs, and its file.

Legend: N frames, R runs, H horizon.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.motion.attribution import Attribution, find_row, read_attributions
from face_prediction.motion.motion import (
    ClipMotion,
    MotionSettings,
    QualityLimits,
    lift,
    step_tremor,
)
from face_prediction.motion.splice import SplicedClip, SpliceSettings
from face_prediction.tracking.geometry import VERTICAL_FOV_DEGREES, continuous_quaternions
from face_prediction.tracking.tracks import load_track
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import FileKind
from robo_manip_baselines.runs.npz import ArrayType, FileType, read_json_array, read_npz, write_npz

SCHEMA = "recorded_face_motion"
VERSION = 1

SAME_MOTION = 2e-4
"""m, and elements of quaternions, by which two extractions of one video may differ: ten times what
two machines differ by (MediaPipe 0.10.30, 24 µm)."""

_MOTION = ("mouth", "orientation", "jaw")

CAMERA_MODEL = (
    f"pinhole, {VERTICAL_FOV_DEGREES:g} degrees vertical field of view (assumed), principal point "
    "in the middle of the image, square pixels; origin at the camera, x right in the image, y up, "
    "z toward the camera; scale from MediaPipe's canonical face"
)
HEAD_POSE = (
    "MediaPipe's fit of its canonical face, to the 25 of its 33 landmarks that do not move with "
    "the mouth (brow, eyes, temples, nose)"
)
MOUTH_MODEL = (
    "mean of the 40 lip landmarks, each on its image ray where that meets the plane through the "
    "canonical mouth centre, normal to the head's z axis"
)

LIBRARY_FILE = FileType(
    SCHEMA,
    VERSION,
    {
        "fps": ArrayType("f", (), "positive"),
        "time": ArrayType("f", ("N",)),
        "mouth": ArrayType("f", ("N", 3)),
        "orientation": ArrayType("f", ("N", 4), "quaternion"),  # float32 ones are unit to 1e-7
        "jaw": ArrayType("f", ("N",), "not negative"),
        "run_start": ArrayType("iu", ("R",), "not negative"),
        "run_length": ArrayType("iu", ("R",), "positive"),
        "run_clip": ArrayType("U", ("R",)),
        "run_subject": ArrayType("U", ("R",)),
        "metadata": ArrayType("U"),
        "predicted_mouth": ArrayType("f", ("N", "H", 3), is_optional=True),
        "blended": ArrayType("b", ("N",), is_optional=True),
        "mirrored": ArrayType("b", ("N",), is_optional=True),
    },
    # A day at 30 frames a second, in runs of a second; ten seconds ahead.
    limits={"N": 2_592_000, "R": 86_400, "H": 300},
)
"""Arrays of a library file; robo_manip_baselines reads the same file for its environments."""


def track_files(given: Iterable[Path]) -> list[Path]:
    """The track files named, or in the folders named.

    Raises:
        RequestError: a path does not exist, a folder holds no track, or two share a clip's name.
    """
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            inside = sorted(path.glob("*.npz"))
            if not inside:
                raise RequestError(f"{path}: no .npz file in it; make tracks with extract")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise RequestError(f"{path}: no such file or folder; make tracks with extract")
    if not found:
        raise RequestError("no track given; name a folder of tracks")
    names = [path.stem for path in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RequestError(f"two tracks named {', '.join(twice)}; each clip may be given once")
    return found


def attributed_tracks(tracks: Iterable[Path], table: Path | None) -> list[tuple[Path, Attribution]]:
    """The track files named, or in the folders named, with the row of each.

    Without a table every clip may ship, and is its own subject.

    Raises:
        RequestError: as `read_attributions` and `track_files`; or a clip has no row.
    """
    if table is None:
        return [(path, Attribution(path.stem, path.stem, True)) for path in track_files(tracks)]
    rows, paths = read_attributions(table), track_files(tracks)
    found: list[tuple[Path, Attribution]] = []
    for path in paths:
        row = find_row(rows, path.stem)
        if row is None:
            missing = f"no row for '{path.stem}' in {table}; add one (ship yes or no)"
            raise RequestError(f"{path}: {missing}")
        found.append((path, row))
    return found


MOTION_LIBRARY = FileKind("motion library", lambda path: read_npz(path, LIBRARY_FILE))


@dataclass(frozen=True)
class LiftedClip:
    """One clip of a library.

    Attributes:
        path: file of its track.
        row: its attribution.
        motion: lifted from the track.
        detector: record of the track's detector.
        video_sha256: of the video that the track was made from.
    """

    path: Path
    row: Attribution
    motion: ClipMotion
    detector: dict[str, Any]
    video_sha256: str


def lift_clips(
    tracks: Iterable[Path],
    table: Path | None,
    settings: MotionSettings,
    only: Collection[str] | None = None,
) -> tuple[list[LiftedClip], int]:
    """Lift the clips that may ship (of the names ``only``, if given), and count those that may not.

    Raises:
        RequestError: a track has no row or cannot be used, or no clip may ship.
    """
    rows = attributed_tracks(tracks, table)
    if not any(row.ship for _, row in rows):
        none = f"none of the {len(rows)} clips given has ship=yes; nothing may be redistributed"
        raise RequestError(f"--attribution {table}: {none}")
    clips: list[LiftedClip] = []
    for path, row in rows:
        if row.ship and (only is None or row.clip in only):
            track = load_track(path)
            video = str(track.source.get("sha256", ""))
            clips.append(LiftedClip(path, row, lift(track, settings), dict(track.detector), video))
    return clips, sum(not row.ship for _, row in rows)


@dataclass(frozen=True)
class RecordedMotion:
    """Runs of recorded face motion. Camera frame: x right in the image, y up, z to the camera.

    Attributes:
        fps: frames per second.
        time: (N,) s from the start of the run.
        mouth: (N, 3) float32 m, mouth centre in the camera frame.
        orientation: (N, 4) float32 wxyz, camera from head.
        jaw: (N,) float32 m between the inner lips.
        run_start: (R,) int64, first frame of the run.
        run_length: (R,) int64 frames.
        run_clip: (R,) names.
        run_subject: (R,) names.
        metadata: what the library was made of, how, and what was cut.
        predicted_mouth: (N, H, 3) float32 m: forecasts of the mouth 1 ... H frames after each
            frame, in the frame of ``mouth``; None: no forecasts.
        blended: (N,) bool: the sample is a blend of two recorded ones; None: none is.
        mirrored: (N,) bool: the sample is played backwards, see `SplicedClip`; None: none is.
    """

    fps: float
    time: np.ndarray
    mouth: np.ndarray
    orientation: np.ndarray
    jaw: np.ndarray
    run_start: np.ndarray
    run_length: np.ndarray
    run_clip: np.ndarray
    run_subject: np.ndarray
    metadata: dict[str, Any]
    predicted_mouth: np.ndarray | None = None
    blended: np.ndarray | None = None
    mirrored: np.ndarray | None = None

    @property
    def seconds(self) -> float:
        """Continuous motion in the library: the time from first to last frame, summed over runs."""
        return float((self.run_length - 1).sum() / self.fps)

    def run(self, index: int) -> slice:
        """The frames of one run."""
        start = int(self.run_start[index])
        return slice(start, start + int(self.run_length[index]))

    def summary(self) -> str:
        """One line: seconds, runs, subjects and the shortest run."""
        subjects = len(set(self.run_subject.tolist()))
        shortest = float(np.min(self.run_length - 1)) / self.fps
        runs = f"{len(self.run_start)} runs of {subjects} subjects"
        return f"{self.seconds:.1f} s in {runs}, the shortest {shortest:.1f} s"

    def settings(self) -> MotionSettings:
        """Settings that the library was made with.

        Raises:
            RequestError: its metadata hold none.
        """
        try:
            stored = self.metadata["settings"]
            return MotionSettings(**{**stored, "limits": QualityLimits(**stored["limits"])})
        except (KeyError, TypeError, ValueError) as error:
            wrong = f"its metadata hold no settings of export-motion ({error}); make it again"
            raise RequestError(f"--library: {wrong}") from None


def record_motion(
    clips: Sequence[LiftedClip],
    settings: MotionSettings,
    withheld: int,
    spliced: Sequence[SplicedClip] = (),
    splicing: SpliceSettings | None = None,
) -> RecordedMotion:
    """Put the runs of clips into a library, with their attribution and what was cut.

    Those of spliced clips, made with the settings ``splicing``, come last.

    Raises:
        RequestError: no clip has a run, or the clips differ in rate.
    """
    detectors = [clip.detector for clip in clips]
    metadata: dict[str, Any] = {
        "camera_model": CAMERA_MODEL,
        "head_pose": HEAD_POSE,
        "mouth": MOUTH_MODEL,
        "settings": asdict(settings),
        "detectors": [d for i, d in enumerate(detectors) if d not in detectors[:i]],
        "attribution": {clip.row.clip: clip.row.record() for clip in clips if clip.motion.runs},
        "clips": {c.row.clip: motion_statistics(c.motion, c.row.subject) for c in clips},
        "withheld_clips": withheld,
        "versions": {"numpy": np.__version__, "library_schema": VERSION},
    }
    parts = [(c.row.clip, c.row.subject, c.motion) for c in clips]
    if not spliced:
        return join_runs(parts, metadata)
    if taken := {clip.name for clip in spliced} & set(metadata["clips"]):
        raise RequestError(f"--splice: a clip is named '{taken.pop()}' already; rename its track")
    metadata["attribution"] |= {clip.name: joint_attribution(clip, clips) for clip in spliced}
    metadata["splices"] = {clip.name: splice_statistics(clip) for clip in spliced}
    metadata["splice_settings"] = None if splicing is None else asdict(splicing)
    library = join_runs([*parts, *((c.name, c.subject, c.motion) for c in spliced)], metadata)
    before = np.zeros(sum(stop - start for c in clips for start, stop in c.motion.runs), dtype=bool)
    return replace(
        library,
        blended=np.concatenate([before, *(clip.kept(clip.blended) for clip in spliced)]),
        mirrored=np.concatenate([before, *(clip.kept(clip.mirrored) for clip in spliced)]),
    )


def with_base(library: RecordedMotion, base: RecordedMotion) -> RecordedMotion:
    """Put the runs of an older library, as they are, in place of the first runs of a new one.

    The detector's numbers differ in the last digits from machine to machine; what was recorded
    with the older library keeps its meaning only with the same ones.

    Raises:
        RequestError: the new library does not begin with the same motion, to `SAME_MOTION`.
    """
    frames, runs = len(base.time), len(base.run_start)
    same = all(
        np.array_equal(getattr(base, name), getattr(library, name)[:runs])
        for name in ("run_clip", "run_subject", "run_length")
    )
    arrays = {name: (getattr(base, name), getattr(library, name)) for name in _MOTION}
    if not same or any(
        not np.allclose(old, new[:frames], rtol=0.0, atol=SAME_MOTION)
        for old, new in arrays.values()
    ):
        raise RequestError("--base: these tracks give other runs; name those that it was made from")
    joined = {name: np.concatenate([old, new[frames:]]) for name, (old, new) in arrays.items()}
    return replace(library, **joined)


def joint_attribution(clip: SplicedClip, clips: Sequence[LiftedClip]) -> dict[str, str]:
    """Subject, licences and sources of the clips that a spliced one is made of."""
    rows = [other.row.record() for other in clips if other.row.clip in clip.clips]
    return {key: "; ".join(dict.fromkeys(row[key] for row in rows)) for key in rows[0]}


def splice_statistics(clip: SplicedClip) -> dict[str, Any]:
    """Stretches of a spliced clip, and what its runs are like."""
    return {
        **motion_statistics(clip.motion, clip.subject),
        "blended": round(float(np.mean(clip.kept(clip.blended))), 3),
        "mirrored": round(float(np.mean(clip.kept(clip.mirrored))), 3),
        "stretches": clip.stretches,
    }


def with_people(library: RecordedMotion, test: Sequence[str]) -> RecordedMotion:
    """Store a split of the people in a library: those of ``test``, and everybody else.

    Nothing is stored if ``test`` is empty.

    Raises:
        RequestError: somebody of ``test`` is not in the library, or nobody else is.
    """
    subjects = sorted(set(library.run_subject.tolist()))
    chosen = {require_choice("subject", name, subjects) for name in test}
    if not chosen:
        return library
    train = [name for name in subjects if name not in chosen]
    if not train:
        raise RequestError("--test_people: names everybody; leave somebody for demonstrations")
    people = {"train": train, "test": sorted(chosen)}
    return replace(library, metadata={**library.metadata, "people": people})


def motion_statistics(motion: ClipMotion, subject: str) -> dict[str, Any]:
    """Counts of frames of one clip, tremor in mm, speeds in cm/s of what is kept.

    The distance is None where no frame could be lifted.
    """
    row: dict[str, Any] = {"subject": subject, **motion.counts()}
    row["seconds"] = round(motion.seconds, 2)
    row["depth_smoothed"] = motion.depth_smoothed
    depth = motion.raw_depth[np.isfinite(motion.raw_depth)]
    row["distance_m"] = round(float(-np.median(depth)), 3) if len(depth) else None
    row["raw_depth_tremor_mm"] = round(1000 * step_tremor(motion.raw_depth), 2)
    if motion.runs:
        kept = [motion.mouth[a:b] for a, b in motion.runs]
        steps = np.concatenate([np.diff(part, axis=0) for part in kept])
        speed = np.linalg.norm(steps, axis=1) * motion.fps * 100
        row["speed_median_cm_s"] = round(float(np.median(speed)), 1)
        row["speed_p95_cm_s"] = round(float(np.percentile(speed, 95)), 1)
        tremors = [max(step_tremor(part[:, axis]) for part in kept) for axis in range(3)]
        row["tremor_mm"] = [round(1000 * tremor, 2) for tremor in tremors]
    return row


def join_runs(
    clips: Sequence[tuple[str, str, ClipMotion]], metadata: dict[str, Any]
) -> RecordedMotion:
    """Put the runs of (clip, subject, motion) one after another.

    Raises:
        RequestError: no clip has a run, or the clips differ in rate.
    """
    parts = [(*clip, slice(*run)) for clip in clips for run in clip[2].runs]
    if not parts:
        raise RequestError("no run is long enough and within reach; nothing to write")
    rates = {motion.fps for _, _, motion in clips}
    if len(rates) > 1:
        raise RequestError(f"tracks of different rates {sorted(rates)}; extract all with one --fps")
    fps = rates.pop()
    lengths = np.array([part.stop - part.start for *_, part in parts], dtype=np.int64)
    orientations = [continuous_quaternions(m.orientation[part]) for _, _, m, part in parts]
    return RecordedMotion(
        fps=fps,
        time=np.concatenate([np.arange(n) / fps for n in lengths]),
        mouth=np.concatenate([m.mouth[part] for _, _, m, part in parts]).astype(np.float32),
        orientation=np.concatenate(orientations).astype(np.float32),
        jaw=np.concatenate([m.jaw[part] for _, _, m, part in parts]).astype(np.float32),
        run_start=np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64),
        run_length=lengths,
        run_clip=np.array([clip for clip, *_ in parts]),
        run_subject=np.array([subject for _, subject, *_ in parts]),
        metadata=metadata,
    )


def save_motion(path: Path, motion: RecordedMotion) -> None:
    """Write ``motion`` to ``path``, whole or not at all."""
    arrays = {"schema": np.array(SCHEMA), "version": np.array(VERSION)}
    for name in LIBRARY_FILE.arrays:
        value = getattr(motion, name)
        if name == "metadata":
            value = json.dumps(value, sort_keys=True, allow_nan=False)  # no reader takes NaN
        if value is not None:
            arrays[name] = np.asarray(value)
    write_npz(path, arrays)


def load_motion(path: Path) -> RecordedMotion:
    """Read and check the library at ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema, or its arrays do not agree;
            the message names the file and the key.
    """
    values: dict[str, Any] = read_npz(path, LIBRARY_FILE)
    values["metadata"] = read_json_array(values, "metadata", path)
    values |= {name: values[name].astype(np.int64) for name in ("run_start", "run_length")}
    values["fps"] = float(values["fps"])
    motion = RecordedMotion(**values)
    joined = np.concatenate([[0], motion.run_start + motion.run_length])
    is_whole = np.array_equal(joined, [*motion.run_start, len(motion.time)])
    if len(joined) == 1 or np.any(motion.run_length < 2) or not is_whole:
        raise RequestError(f"{path}: 'run_start' and 'run_length' do not divide the frames")
    for index, start in enumerate(motion.run_start):
        if np.any(np.diff(motion.time[motion.run(index)]) <= 0):
            raise RequestError(f"{path}: 'time' does not increase in the run from frame {start} on")
    return motion
