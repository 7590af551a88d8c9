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
from robo_manip_baselines.runs.npz import ArrayType, FileType, read_json_array, read_npz, write_npz

SCHEMA = "face_track"
VERSION = 1
NUM_LANDMARKS = 468
"""MediaPipe's face mesh; the ten iris points that the detector adds are not kept."""

Size = tuple[int, int]
"""Width and height of an image in pixels, as displayed."""

TRACK_FILE = FileType(
    SCHEMA,
    VERSION,
    {
        # Frames without a face are NaN.
        "landmarks": ArrayType("f", ("T", NUM_LANDMARKS, 3), "any"),
        "valid": ArrayType("b", ("T",)),
        "interpolated": ArrayType("b", ("T",)),
        "timestamps": ArrayType("f", ("T",), "increasing"),
        "head_pose": ArrayType("f", ("T", 4, 4), "any"),
        "jaw": ArrayType("f", ("T",), "any"),
        "image_size": ArrayType("iu", (2,), "positive"),
        "fps": ArrayType("f", (), "positive"),
        "source_timestamps": ArrayType("f", ("S",)),
        "source_valid": ArrayType("b", ("S",)),
        "source": ArrayType("U"),
        "detector": ArrayType("U"),
    },
    # Two hours at 60 frames a second.
    limits={"T": 432_000, "S": 1_000_000},
)
"""Arrays of a track file."""

_DTYPES = {
    **dict.fromkeys(("landmarks", "jaw"), "float32"),
    **dict.fromkeys(("valid", "interpolated", "source_valid"), "bool"),
    **dict.fromkeys(("timestamps", "head_pose", "fps", "source_timestamps"), "float64"),
    "image_size": "int64",
}
"""Types that are written."""


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
    arrays = {name: np.asarray(getattr(track, name), kind) for name, kind in _DTYPES.items()}
    for name in ("source", "detector"):
        arrays[name] = np.array(json.dumps(dict(getattr(track, name)), sort_keys=True))
    write_npz(path, {"schema": np.array(SCHEMA), "version": np.array(VERSION), **arrays})


def load_track(path: Path) -> FaceTrack:
    """Read and check the face track at ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema, or its arrays do not agree;
            the message names the file and the key.
    """
    values: dict[str, Any] = read_npz(path, TRACK_FILE)
    values |= {name: read_json_array(values, name, path) for name in ("source", "detector")}
    values["image_size"] = tuple(values["image_size"].tolist())
    values["fps"] = float(values["fps"])
    track = FaceTrack(**values)
    for key in ("timestamps", "source_timestamps"):
        if not len(getattr(track, key)):
            raise RequestError(f"{path}: '{key}' is empty; a track holds one frame or more")
    for key in ("landmarks", "head_pose"):
        if not np.all(np.isfinite(getattr(track, key)[track.valid])):
            raise RequestError(f"{path}: '{key}' holds NaN or infinity in a frame marked valid")
    if np.any(track.jaw < 0) or np.any(np.isinf(track.jaw)):
        raise RequestError(f"{path}: 'jaw' holds distances that are negative or infinite")
    return track
