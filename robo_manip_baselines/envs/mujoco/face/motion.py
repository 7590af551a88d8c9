"""Recorded face motion: the library that ships with the package, and segments drawn from it.

Shapes: N frames of the whole library, R runs, M frames of a segment, H = 5 frames of a prediction,
``...`` any shape of times.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from robo_manip_baselines.observation import MAX_HORIZON
from robo_manip_baselines.observation.corruption import FRAME_RATE
from robo_manip_baselines.runs.errors import RequestError, require_choice

DEFAULT_LIBRARY = Path(__file__).with_name("assets") / "face_motion.npz"

SEGMENT_DURATION = 12.0
"""Seconds of recorded motion replayed in an episode (paper, section IV.C)."""

WORLD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""World axes (x right, y forward, z up) from the recording camera's (x right, y up, z towards
it), for a face that looks along world +x."""


@dataclass(frozen=True)
class MotionSegment:
    """Motion of a face in an episode: a stretch of one recorded run, or computed (`motions`).

    Attributes:
        fps: frames per second.
        displacement: (M, 3) m, world axes, from where the run's stretch starts, or from where the
            face rests in a computed motion.
        orientation: (M, 4) wxyz, recording camera from head.
        jaw: (M,) m between the inner lips.
        clip: id of the clip.
        subject: id of the person.
        start: first frame, counted from the start of the run.
        index: the same frame, counted from the start of the library.
        predicted: (M, H, 3) m, world axes, where a trained predictor said in each frame that the
            mouth would be 1 ... H frames later, as a displacement; None in a library without.
    """

    fps: float
    displacement: NDArray[np.float64]
    orientation: NDArray[np.float64]
    jaw: NDArray[np.float64]
    clip: str
    subject: str
    start: int
    index: int
    predicted: NDArray[np.float64] | None = None

    def prediction_error(self, time: ArrayLike) -> NDArray[np.float64] | None:
        """Return prediction minus truth, (..., H, 3) m, of the last frame up to ``time`` (...) s.

        Held at both ends outside the segment; None in a library without predictions.
        """
        if self.predicted is None:
            return None
        last = len(self.jaw) - 1
        # A millionth of a frame for times that are meant to be those of frames.
        frame = np.floor(np.asarray(time, dtype=np.float64) * self.fps + 1e-6).astype(np.int64)
        frame = np.clip(frame, 0, last)
        ahead = np.arange(1, self.predicted.shape[1] + 1)
        return self.predicted[frame] - self.displacement[np.minimum(frame[..., None] + ahead, last)]

    def at(
        self, time: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Interpolate at ``time`` (...) s since the start; held at both ends outside the segment.

        Returns:
            displacement (..., 3) m, orientation (..., 4) wxyz (by slerp) and jaw (...) m.
        """
        last = len(self.jaw) - 1
        frame = np.clip(np.asarray(time, dtype=np.float64) * self.fps, 0.0, last)
        flat = frame.ravel()
        knots = np.arange(last + 1)
        slerp = Slerp(knots, Rotation.from_quat(self.orientation, scalar_first=True))
        orientation = slerp(flat).as_quat(scalar_first=True, canonical=True)
        jaw = np.interp(flat, knots, self.jaw)
        shape = frame.shape
        return self.displacement_at(time), orientation.reshape(*shape, 4), jaw.reshape(shape)

    def displacement_at(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return the displacement (..., 3) m of `at` alone, which takes much less time."""
        frame = np.asarray(time, dtype=np.float64) * self.fps
        knots = np.arange(len(self.jaw))
        return np.stack([np.interp(frame, knots, axis) for axis in self.displacement.T], axis=-1)


@dataclass(frozen=True)
class MotionLibrary:
    """Runs of continuous recorded motion, in the frame of the camera that saw them.

    Attributes:
        fps: frames per second.
        mouth: (N, 3) m, mouth centre; camera frame (x right, y up, z towards the camera).
        orientation: (N, 4) wxyz, camera from head.
        jaw: (N,) m between the inner lips.
        run_start, run_length: (R,) where each run lies.
        run_clip, run_subject: (R,) ids.
        metadata: attribution, camera model, and what was left out.
        source: the file it came from.
        predicted: (N, H, 3) m, where a trained predictor said in each frame that the mouth would
            be 1 ... H frames later; None if the library has no predictions.
    """

    fps: float
    mouth: NDArray[np.float64]
    orientation: NDArray[np.float64]
    jaw: NDArray[np.float64]
    run_start: NDArray[np.int64]
    run_length: NDArray[np.int64]
    run_clip: tuple[str, ...]
    run_subject: tuple[str, ...]
    metadata: dict[str, Any]
    source: Path
    predicted: NDArray[np.float64] | None = None

    @classmethod
    def load(cls, path: Path | str | None = None) -> MotionLibrary:
        """Read a library written by ``face_prediction export-motion``.

        Args:
            path: the file; the one that ships with the package if None.

        Raises:
            RequestError: the file is missing, damaged or of another schema.
        """
        source = Path(path) if path is not None else DEFAULT_LIBRARY
        remedy = "make one with 'python -m face_prediction export-motion' or leave the option out"
        if not source.is_file():
            raise RequestError(f"motion library '{source}' does not exist; {remedy}")
        try:
            with source.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
                content = {key: archive[key] for key in archive.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            problem = f"motion library '{source}' cannot be read ({reason})"
            raise RequestError(f"{problem}; {remedy}") from error
        problem = find_problem(content)
        if problem:
            raise RequestError(f"motion library '{source}' is damaged: {problem}; {remedy}")
        return cls(
            fps=float(content["fps"]),
            mouth=content["mouth"].astype(np.float64),
            orientation=content["orientation"].astype(np.float64),
            jaw=content["jaw"].astype(np.float64),
            run_start=content["run_start"].astype(np.int64),
            run_length=content["run_length"].astype(np.int64),
            run_clip=tuple(str(clip) for clip in content["run_clip"]),
            run_subject=tuple(str(subject) for subject in content["run_subject"]),
            metadata=json.loads(str(content["metadata"])),
            source=source,
            predicted=content[PREDICTION].astype(np.float64) if PREDICTION in content else None,
        )

    def starts(self) -> NDArray[np.int64]:
        """Return, (R,), how many frames of each run can start a segment of `SEGMENT_DURATION`."""
        return np.maximum(self.run_length - math.ceil(SEGMENT_DURATION * self.fps), 0)

    def draw(self, rng: np.random.Generator, clips: Sequence[str] | None = None) -> MotionSegment:
        """Draw a segment whose start is uniform over all frames that can start one.

        Args:
            rng: the only source of chance.
            clips: ids of the clips to draw from; all if None.

        Raises:
            RequestError: no such clip, or no run is long enough.
        """
        counts = self.starts()
        if clips is not None:
            wanted = {require_choice("clip", clip, self.run_clip) for clip in clips}
            counts = np.where([clip in wanted for clip in self.run_clip], counts, 0)
        total = int(counts.sum())
        if total == 0:
            where = f" in clips {', '.join(clips)}" if clips else ""
            lacking = f"no run of '{self.source.name}' lasts {SEGMENT_DURATION:g} s{where}"
            raise RequestError(f"{lacking}; choose other clips")
        index = int(rng.integers(total))
        run = int(np.searchsorted(np.cumsum(counts), index, side="right"))
        return self.segment(run, index - int(counts[:run].sum()))

    def segment(self, run: int, start: int) -> MotionSegment:
        """Cut a segment of `SEGMENT_DURATION` from frame ``start`` of a run.

        It is followed by the frames of the longest prediction horizon where the run has them,
        so that the truth about the future exists until the end of the episode.
        """
        begin = int(self.run_start[run]) + start
        run_end = int(self.run_start[run] + self.run_length[run])
        end = min(begin + math.ceil(SEGMENT_DURATION * self.fps) + 1 + MAX_HORIZON, run_end)

        def moved(mouth: NDArray[np.float64]) -> NDArray[np.float64]:
            return (mouth[begin:end] - self.mouth[begin]) @ WORLD_FROM_CAMERA.T

        return MotionSegment(
            fps=self.fps,
            displacement=moved(self.mouth),
            orientation=self.orientation[begin:end],
            jaw=self.jaw[begin:end],
            clip=self.run_clip[run],
            subject=self.run_subject[run],
            start=start,
            index=begin,
            predicted=None if self.predicted is None else moved(self.predicted),
        )


SCHEMA = "recorded_face_motion"
VERSION = 1

_ARRAYS = {
    "time": (1, "f"),
    "mouth": (2, "f"),
    "orientation": (2, "f"),
    "jaw": (1, "f"),
    "run_start": (1, "i"),
    "run_length": (1, "i"),
    "run_clip": (1, "U"),
    "run_subject": (1, "U"),
}

PREDICTION = "predicted_mouth"
"""(N, H, 3), the one array that a library may lack."""


def find_problem(content: dict[str, NDArray[Any]]) -> str | None:
    """Return what is wrong with the arrays of a library file, or None."""
    if str(content.get("schema")) != SCHEMA:
        return f"schema is '{content.get('schema')}', not '{SCHEMA}'"
    if str(content.get("version")) != str(VERSION):
        return f"version is {content.get('version')}, this release reads {VERSION}"
    fps = content.get("fps", np.array(0.0))
    if fps.shape or fps.dtype.kind not in "fi" or not 0.0 < float(fps) < np.inf:
        return "'fps' must be one positive number"
    try:
        json.loads(str(content["metadata"]))
    except (KeyError, ValueError):
        return "'metadata' is missing or not JSON"
    for name, (ndim, kind) in _ARRAYS.items():
        if name not in content:
            return f"'{name}' is missing"
        if content[name].ndim != ndim or content[name].dtype.kind != kind:
            return f"'{name}' has shape {content[name].shape} and type {content[name].dtype}"
        if kind == "f" and not np.isfinite(content[name]).all():
            return f"'{name}' holds values that are not finite"
    frames = len(content["time"])
    if content["mouth"].shape != (frames, 3) or content["orientation"].shape != (frames, 4):
        return "'mouth' and 'orientation' must have a row per frame, of 3 and 4 numbers"
    if len(content["jaw"]) != frames:
        return "'jaw' must have a number per frame"
    if problem := _prediction_problem(content, frames):
        return problem
    if not np.allclose(np.linalg.norm(content["orientation"], axis=1), 1.0, atol=1e-3):
        return "'orientation' holds quaternions that are not of unit length"
    start, length = content["run_start"], content["run_length"]
    counts = {len(content[name]) for name in ("run_start", "run_length", "run_clip", "run_subject")}
    if len(counts) != 1:
        return "the run_* arrays differ in length"
    if (start < 0).any() or (length < 1).any() or (start + length > frames).any():
        return "a run lies outside the frames"
    return None


def _prediction_problem(content: dict[str, NDArray[Any]], frames: int) -> str | None:
    """Return what is wrong with the predictions of a library file, if it has any, or None."""
    predicted = content.get(PREDICTION)
    if predicted is None:
        return None
    shape = (frames, MAX_HORIZON, 3)
    if predicted.shape != shape or predicted.dtype.kind != "f":
        return f"'{PREDICTION}' has shape {predicted.shape} and type {predicted.dtype}, not {shape}"
    if not np.isfinite(predicted).all():
        return f"'{PREDICTION}' holds values that are not finite"
    if float(content["fps"]) != FRAME_RATE:
        return f"'{PREDICTION}' is of frames at {FRAME_RATE:g} a second, 'fps' is {content['fps']}"
    return None
