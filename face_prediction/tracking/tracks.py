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
from robo_manip_baselines.runs.npz import read_npz, require_array, require_json, write_npz

SCHEMA = "face_track"
VERSION = 1
NUM_LANDMARKS = 468
"""MediaPipe's face mesh; the ten iris points that the detector adds are not kept."""

Size = tuple[int, int]
"""Width and height of an image in pixels, as displayed."""

_ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "landmarks": ("float32", ("T", NUM_LANDMARKS, 3)),
    "valid": ("bool", ("T",)),
    "interpolated": ("bool", ("T",)),
    "timestamps": ("float64", ("T",)),
    "head_pose": ("float64", ("T", 4, 4)),
    "jaw": ("float32", ("T",)),
    "image_size": ("int64", (2,)),
    "fps": ("float64", ()),
    "source_timestamps": ("float64", ("S",)),
    "source_valid": ("bool", ("S",)),
}
"""Type and shape of every array, in the order of the file."""


class NoFaceError(RequestError):
    """A video was read to its end and held no face that the detector could find."""


@dataclass(frozen=True)
class FaceTrack:
    """One face of one video at a constant rate.

    Frames without a face, and frames inside a gap too long to interpolate across, have ``valid``
    False and NaN in the other arrays.

    Attributes:
        landmarks: (T, 468, 3) float32: x right / image width, y down / image height, and
            MediaPipe's relative depth z (smaller is nearer) / image width.
        valid: (T,) bool.
        interpolated: (T,) bool: the frame lies between two decoded frames and was interpolated.
        timestamps: (T,) float64, seconds on the video's clock.
        head_pose: (T, 4, 4) float64, metres: camera from head. Camera frame: x right in the image,
            y up, z toward the camera. Head frame: MediaPipe's canonical face (x subject's left,
            y up, z out).
        jaw: (T,) float32, metres between the inner lips (landmarks 13 and 14); NaN also where the
            mouth is seen from the side.
        image_size: (width, height) in pixels, as displayed.
        fps: frames per second of the arrays above.
        source_timestamps: (S,) float64 s of every decoded frame.
        source_valid: (S,) bool: the face was found in the decoded frame.
        source: name, sha256, frame counts and rates of the video.
        detector: name, version, model hash, running mode and settings of the detector.
    """

    landmarks: np.ndarray
    valid: np.ndarray
    interpolated: np.ndarray
    timestamps: np.ndarray
    head_pose: np.ndarray
    jaw: np.ndarray
    image_size: Size
    fps: float
    source_timestamps: np.ndarray
    source_valid: np.ndarray
    source: Mapping[str, Any] = field(default_factory=dict)
    detector: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.valid)

    @property
    def has_constant_rate(self) -> bool:
        """Frames are 1 / fps apart, to a millisecond (container clocks tick that coarsely)."""
        return bool(np.all(np.abs(np.diff(self.timestamps) - 1 / self.fps) < 1e-3))


def save_track(path: Path, track: FaceTrack) -> None:
    """Write ``track`` to ``path``, whole or not at all."""
    arrays = {name: np.asarray(getattr(track, name), kind) for name, (kind, _) in _ARRAYS.items()}
    for name in ("source", "detector"):
        arrays[name] = np.array(json.dumps(dict(getattr(track, name)), sort_keys=True))
    write_npz(path, {"schema": np.array(SCHEMA), "version": np.array(VERSION), **arrays})


def load_track(path: Path) -> FaceTrack:
    """Read and check the face track at ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema, or its arrays do not agree;
            the message names the file and the key.
    """
    arrays = read_npz(path, SCHEMA, VERSION)
    keys = {"T": "valid", "S": "source_valid"}
    lengths = {n: len(require_array(path, arrays, key, (None,), "b")) for n, key in keys.items()}
    values: dict[str, Any] = {}
    for name, (dtype, shape) in _ARRAYS.items():
        sizes = tuple(lengths[n] if isinstance(n, str) else n for n in shape)
        kind = np.dtype(dtype).kind.replace("i", "iu")
        values[name] = require_array(path, arrays, name, sizes, kind)
    values["image_size"] = tuple(values["image_size"].tolist())
    values["fps"] = float(values["fps"])
    values |= {name: require_json(path, arrays, name) for name in ("source", "detector")}
    track = FaceTrack(**values)
    if min(track.image_size) <= 0 or not (np.isfinite(track.fps) and track.fps > 0):
        wrong = f"image_size {track.image_size} and fps {track.fps}"
        raise RequestError(f"{path}: {wrong} must be positive")
    if not np.all(np.isfinite(track.timestamps)) or np.any(np.diff(track.timestamps) <= 0):
        raise RequestError(f"{path}: 'timestamps' must be finite and increasing")
    for key in ("landmarks", "head_pose"):
        if not np.all(np.isfinite(getattr(track, key)[track.valid])):
            raise RequestError(f"{path}: '{key}' holds NaN or infinity in a frame marked valid")
    return track
