"""Recorded face motion: the libraries that ship with the package, and segments drawn from them.

Shapes: N frames of the whole library, R runs, M frames of a segment, H frames of a prediction,
``...`` any shape of times.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from robo_manip_baselines.envs.mujoco.face.people import PEOPLE, PeopleSplit, split_runs
from robo_manip_baselines.observation import MAX_HORIZON
from robo_manip_baselines.observation.corruption import FRAME_RATE
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.npz import (
    Arrays,
    ArrayType,
    FileType,
    add_array,
    read_json_array,
    read_npz,
)
from robo_manip_baselines.runs.seeds import stream_generator

_ASSETS = Path(__file__).with_name("assets")

DEFAULT_LIBRARY = _ASSETS / "face_motion.npz"

LIBRARIES = {"extended": _ASSETS / "face_motion_extended.npz"}
"""Name of a library that ships beside the default one -> its file."""

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
        predicted: (M, H, 3) m, world axes, the mouth 1 ... H frames later as a trained
            predictor forecast it in each frame, as a displacement; None in a library without.
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
        predicted: (N, H, 3) m, the mouth 1 ... H frames later as a trained predictor forecast it in
            each frame; None if the library has no predictions.
        people: whose runs it holds: ``all``, or those of one `part`.
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
    people: str = "all"

    @classmethod
    def load(cls, path: Path | str | None = None) -> MotionLibrary:
        """Read a library written by ``face_prediction export-motion``.

        Args:
            path: the file, or a name of `LIBRARIES`; the one that ships with the package if None.

        Raises:
            RequestError: the file is missing, damaged or of another schema.
        """
        source = library_file(path) or DEFAULT_LIBRARY
        content = read_library(source)
        return cls(
            fps=float(content["fps"]),
            mouth=content["mouth"].astype(np.float64),
            orientation=content["orientation"].astype(np.float64),
            jaw=content["jaw"].astype(np.float64),
            run_start=content["run_start"].astype(np.int64),
            run_length=content["run_length"].astype(np.int64),
            run_clip=tuple(str(clip) for clip in content["run_clip"]),
            run_subject=tuple(str(subject) for subject in content["run_subject"]),
            metadata=read_json_array(content, "metadata", source),
            source=source,
            predicted=content[PREDICTION].astype(np.float64) if PREDICTION in content else None,
        )

    @property
    def predicted_frames(self) -> int:
        """H, how many frames ahead the predictions look; 0 without predictions."""
        return 0 if self.predicted is None else self.predicted.shape[1]

    @cached_property
    def motion_sha256(self) -> str:
        """SHA-256 of the recorded motion, without predictions; 64 hexadecimal digits."""
        digest = hashlib.sha256()
        for name in ("mouth", "orientation", "jaw", "run_start", "run_length"):
            add_array(digest, name, getattr(self, name))
        names: dict[str, Any] = {"fps": self.fps, "clips": self.run_clip}
        names["subjects"] = self.run_subject
        if self._stored_split:  # it decides who is drawn, as the motion does
            names["people"] = [self._stored_split.train, self._stored_split.test]
        digest.update(json.dumps(names).encode())
        return digest.hexdigest()

    @cached_property
    def prediction_sha256(self) -> str | None:
        """SHA-256 of the predictions; None in a library without."""
        if self.predicted is None:
            return None
        digest = hashlib.sha256()
        add_array(digest, PREDICTION, self.predicted)
        return digest.hexdigest()

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of motion and predictions, whatever file they came from."""
        parts = f"{self.motion_sha256} {self.prediction_sha256}"
        return hashlib.sha256(parts.encode()).hexdigest()

    def require(self, sha256: str | None) -> None:
        """Require that this is the library of a digest, if one is given.

        Raises:
            RequestError: it is another one.
        """
        if sha256 not in (None, self.sha256):
            raise RequestError(
                f"motion library '{self.source}' holds other motion than what was used before "
                f"(SHA-256 {self.sha256[:12]}, not {sha256[:12]}); give the file that was used as "
                "motion_library"
            )

    @cached_property
    def _stored_split(self) -> PeopleSplit | None:
        return PeopleSplit.of(self.metadata, f"motion library '{self.source}'")

    @cached_property
    def _parts(self) -> dict[str, MotionLibrary]:
        # A part holds the runs that it may draw from and no other frame of them, so that no replay,
        # however fast, leaves it.
        least = math.ceil(SEGMENT_DURATION * self.fps) + 1
        runs = (self.run_subject, self.run_clip, self.run_start, self.run_length)
        stored = self._stored_split
        try:
            parts = split_runs(*runs, least=least, stored=stored)
        except RequestError as error:
            raise RequestError(f"motion library '{self.source}': {error}") from None
        return {
            name: replace(
                self,
                run_start=part.start,
                run_length=part.length,
                run_clip=tuple(self.run_clip[run] for run in part.run),
                run_subject=tuple(self.run_subject[run] for run in part.run),
                people=name,
            )
            for name, part in parts.items()
        }

    def part(self, people: str) -> MotionLibrary:
        """Return the runs of ``train`` or ``test`` people, see `split_runs`; of ``all``, itself.

        Raises:
            RequestError: there is no such part, or the library cannot be split.
        """
        if require_choice("people", people, PEOPLE) == self.people:
            return self
        return self._parts[people]

    def starts(self) -> NDArray[np.int64]:
        """Return, (R,), how many frames of each run can start a segment of `SEGMENT_DURATION`."""
        return np.maximum(self.run_length - math.ceil(SEGMENT_DURATION * self.fps), 0)

    def draw(self, rng: np.random.Generator, clips: Sequence[str] | None = None) -> MotionSegment:
        """Draw a segment whose start is uniform over all frames that can start one.

        Of a part, a person is drawn first, then one of that person's frames: nobody makes up most
        of the episodes by having the longest recording.

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
        if not counts.any():
            where = f" in clips {', '.join(clips)}" if clips else ""
            where += f" of the people '{self.people}'" if self.people != "all" else ""
            lacking = f"no run of '{self.source.name}' lasts {SEGMENT_DURATION:g} s{where}"
            raise RequestError(f"{lacking}; choose other clips")
        if self.people != "all":
            # One number is taken, as for all people: what is drawn later is the same.
            rng = stream_generator(int(rng.integers(2**32)), f"face motion of {self.people}")
            present = zip(self.run_subject, counts, strict=True)
            persons = sorted({subject for subject, count in present if count})
            person = persons[int(rng.integers(len(persons)))]
            counts = np.where([subject == person for subject in self.run_subject], counts, 0)
        total = int(counts.sum())
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


PREDICTION = "predicted_mouth"
"""(N, H, 3), an array that a library may lack."""

LIBRARY_FILE = FileType(
    "recorded_face_motion",
    1,
    {
        "fps": ArrayType("f", (), "positive"),
        "time": ArrayType("f", ("N",)),
        "mouth": ArrayType("f", ("N", 3)),
        "orientation": ArrayType("f", ("N", 4), "quaternion"),
        "jaw": ArrayType("f", ("N",), "not negative"),
        "run_start": ArrayType("iu", ("R",), "not negative"),
        "run_length": ArrayType("iu", ("R",), "positive"),
        "run_clip": ArrayType("U", ("R",)),
        "run_subject": ArrayType("U", ("R",)),
        PREDICTION: ArrayType("f", ("N", "H", 3), is_optional=True),
        # Marks of spliced runs, for whoever analyses results.
        "blended": ArrayType("b", ("N",), is_optional=True),
        "mirrored": ArrayType("b", ("N",), is_optional=True),
        "metadata": ArrayType("U"),
    },
    # A day at 30 frames a second, in runs of a second.
    limits={"N": 2_592_000, "R": 86_400, "H": MAX_HORIZON},
    quaternion_tolerance=1e-3,
)
"""Arrays of a library file."""


def library_file(given: Path | str | None) -> Path | None:
    """Return the file of a library that is given by its path or by a name of `LIBRARIES`.

    A file of such a name is given as ``./extended``.
    """
    return None if given is None else LIBRARIES.get(str(given), Path(given))


def read_library(path: Path) -> Arrays:
    """Read and check the arrays of a library file.

    Raises:
        RequestError: the file is missing, damaged or of another schema.
    """
    remedy = (
        "make one with 'python -m face_prediction export-motion', leave the option out, or take "
        f"one that ships: {', '.join(LIBRARIES)}"
    )
    name = f"motion library '{path}'"
    if not path.is_file():
        raise RequestError(f"{name} does not exist; {remedy}")
    content = read_npz(path, LIBRARY_FILE, name=name, remedy=remedy)
    if problem := _run_problem(content):
        raise RequestError(f"{name}: {problem}; {remedy}")
    read_json_array(content, "metadata", name)
    return content


def _run_problem(content: Arrays) -> str:
    """Return what is wrong with the runs of a library file, or nothing."""
    if not len(content["run_start"]):
        return "it holds no run"
    start, length = (content[name].astype(np.float64) for name in ("run_start", "run_length"))
    if (start + length > len(content["time"])).any():  # no overflow in float64
        return "'run_start' and 'run_length': a run lies outside the frames"
    for first, number in zip(content["run_start"], content["run_length"], strict=True):
        if np.any(np.diff(content["time"][int(first) : int(first) + int(number)]) <= 0):
            return f"'time' does not increase in the run from frame {first} on"
    fps = float(content["fps"])
    if PREDICTION in content and not content[PREDICTION].shape[1]:
        return f"'{PREDICTION}' is of no frame ahead"
    if PREDICTION in content and fps != FRAME_RATE:
        return f"'{PREDICTION}' is of frames at {FRAME_RATE:g} a second, 'fps' is {fps}"
    return ""


def pin_library(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment with the digest of the motion library that they name.

    Raises:
        RequestError: the file cannot be used, or is another one than that of ``motion_sha256``.
    """
    pinned = dict(env_kwargs)
    if path := pinned.get("motion_library"):
        library = MotionLibrary.load(path)
        library.require(pinned.get("motion_sha256"))
        pinned["motion_sha256"] = library.sha256
    return pinned
