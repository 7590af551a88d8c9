"""``FaceTrack``: one face followed through one video, and its file.

Legend: T frames, S source frames, L = 468 landmarks.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import read_npz, require_array, write_npz

SCHEMA = "face_track"
VERSION = 1
#: MediaPipe's face mesh; the ten iris points that the detector adds are not kept.
NUM_LANDMARKS = 468


class NoFaceError(RequestError):
    """A video was read to its end and held no face that the detector could find."""


@dataclass(frozen=True)
class FaceTrack:
    """One face of one video at a constant rate.

    Frames without a face, and frames that could only be guessed across a gap, have ``valid``
    False and NaN in the others.
    """

    #: (T, 468, 3) float32: x right / image width, y down / image height, and MediaPipe's relative
    #: depth z (smaller is nearer) / image width.
    landmarks: np.ndarray
    #: (T,) bool
    valid: np.ndarray
    #: (T,) bool: the frame lies between two decoded frames and was interpolated from them.
    interpolated: np.ndarray
    #: (T,) float64, seconds on the video's clock
    timestamps: np.ndarray
    #: (T, 4, 4) float64, metres: camera from head. Camera frame: x right in the image, y up,
    #: z toward the camera. Head frame: MediaPipe's canonical face (x subject's left, y up, z out).
    head_pose: np.ndarray
    #: (T,) float32, metres between the inner lips (landmarks 13 and 14); NaN also where the mouth
    #: is seen from the side
    jaw: np.ndarray
    #: (width, height) in pixels, as displayed
    image_size: tuple[int, int]
    #: frames per second of the arrays above
    fps: float
    #: (S,) float64 s and (S,) bool: every decoded frame, and whether the face was found in it
    source_timestamps: np.ndarray
    source_valid: np.ndarray
    #: name, sha256, frame counts and rates of the video
    source: Mapping[str, Any] = field(default_factory=dict)
    #: name, version, model hash, running mode and settings of the detector
    detector: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.valid)


def save_track(path: Path, track: FaceTrack) -> None:
    """Write ``track`` to ``path``, whole or not at all."""
    write_npz(
        path,
        {
            "schema": np.array(SCHEMA),
            "version": np.array(VERSION),
            "landmarks": track.landmarks.astype(np.float32),
            "valid": track.valid.astype(bool),
            "interpolated": track.interpolated.astype(bool),
            "timestamps": track.timestamps.astype(np.float64),
            "head_pose": track.head_pose.astype(np.float64),
            "jaw": track.jaw.astype(np.float32),
            "image_size": np.array(track.image_size, dtype=np.int64),
            "fps": np.array(track.fps, dtype=np.float64),
            "source_timestamps": track.source_timestamps.astype(np.float64),
            "source_valid": track.source_valid.astype(bool),
            "source": np.array(json.dumps(dict(track.source), sort_keys=True)),
            "detector": np.array(json.dumps(dict(track.detector), sort_keys=True)),
        },
    )


def load_track(path: Path) -> FaceTrack:
    """Read and check the face track at ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema, or breaks a promise of
            :class:`FaceTrack`; the message names the file and the key.
    """
    arrays = read_npz(path, SCHEMA, VERSION)
    valid = require_array(path, arrays, "valid", (None,), "b")
    frames = len(valid)
    source_valid = require_array(path, arrays, "source_valid", (None,), "b")
    size = require_array(path, arrays, "image_size", (2,), "iu")
    track = FaceTrack(
        landmarks=require_array(path, arrays, "landmarks", (frames, NUM_LANDMARKS, 3), "f"),
        valid=valid,
        interpolated=require_array(path, arrays, "interpolated", (frames,), "b"),
        timestamps=require_array(path, arrays, "timestamps", (frames,), "f"),
        head_pose=require_array(path, arrays, "head_pose", (frames, 4, 4), "f"),
        jaw=require_array(path, arrays, "jaw", (frames,), "f"),
        image_size=(int(size[0]), int(size[1])),
        fps=float(require_array(path, arrays, "fps", (), "f")),
        source_timestamps=require_array(
            path, arrays, "source_timestamps", (len(source_valid),), "f"
        ),
        source_valid=source_valid,
        source=_mapping(path, arrays, "source"),
        detector=_mapping(path, arrays, "detector"),
    )
    _check_values(path, track)
    return track


def _mapping(path: Path, arrays: dict[str, np.ndarray], key: str) -> dict[str, Any]:
    text = str(require_array(path, arrays, key, (), "U"))
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, dict):
        raise RequestError(f"{path}: '{key}' is not a JSON object; make the file again")
    return value


def _check_values(path: Path, track: FaceTrack) -> None:
    if min(track.image_size) <= 0 or not (np.isfinite(track.fps) and track.fps > 0):
        raise RequestError(
            f"{path}: image_size {track.image_size} and fps {track.fps} must be positive"
        )
    steps = np.diff(track.timestamps)
    if not np.all(np.isfinite(track.timestamps)) or np.any(steps <= 0):
        raise RequestError(f"{path}: 'timestamps' must be finite and increasing")
    for key in ("landmarks", "head_pose"):
        array = getattr(track, key)
        if not np.all(np.isfinite(array[track.valid])):
            raise RequestError(f"{path}: '{key}' holds NaN or infinity in a frame marked valid")
