"""Head pose from landmarks: MediaPipe's face geometry pipeline in NumPy.

MediaPipe gives the pose of a face under the camera of the image it was shown. When it is shown a
crop, for a small face, that camera is the wrong one; this computes the pose that it would have
given had it found the same landmarks in the whole image. On whole images the two agree (tested).

The steps are those of ``mediapipe/modules/face_geometry/libs/geometry_pipeline.cc``. Legend: L =
468 landmarks.
"""

from __future__ import annotations

import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from face_prediction.errors import RequestError
from face_prediction.lifting import VERTICAL_FOV_DEGREES

GEOMETRY_FILE = "geometry_pipeline_metadata_landmarks.binarypb"
CENTIMETRE = 0.01
_VERTEX_FLOATS = 5  # x, y, z in centimetres, and two texture coordinates


@dataclass(frozen=True)
class CanonicalFace:
    """MediaPipe's canonical face: vertices (L, 3) in metres, weights (L,) of the pose fit."""

    vertices: np.ndarray
    weights: np.ndarray


def read_canonical_face(model: Path) -> CanonicalFace:
    """The canonical face stored inside ``face_landmarker.task``.

    Raises:
        RequestError: the file is not such a model.
    """
    try:
        with zipfile.ZipFile(model) as archive:
            fields = _fields(archive.read(GEOMETRY_FILE))
        # GeometryPipelineMetadata: 1 canonical_mesh, 2 procrustes_landmark_basis (id, weight);
        # Mesh3d: 3 vertex_buffer
        mesh = _fields(_bytes(next(value for key, value in fields if key == 1)))
        floats = [struct.unpack("<f", _bytes(value))[0] for key, value in mesh if key == 3]
        vertices = np.array(floats).reshape(-1, _VERTEX_FLOATS)[:, :3] * CENTIMETRE
        weights = np.zeros(len(vertices))
        for key, value in fields:
            if key == 2:
                basis = dict(_fields(_bytes(value)))
                weights[int(basis[1])] = struct.unpack("<f", _bytes(basis[2]))[0]
    except (
        zipfile.BadZipFile,
        KeyError,
        OSError,
        StopIteration,
        ValueError,
        IndexError,
        struct.error,
    ) as error:
        raise RequestError(
            f"{model}: not a face landmarker model ({type(error).__name__}: {error})"
        ) from None
    return CanonicalFace(vertices, weights)


def head_pose_from_landmarks(
    landmarks: np.ndarray, image_size: tuple[int, int], face: CanonicalFace
) -> np.ndarray:
    """Pose (4, 4) in metres, camera from head, of landmarks (L, 3) normalised to the image.

    The relative depth of the landmarks is on the scale of their x, so the whole face has one free
    scale, found in two rounds: first without perspective, then with it.
    """
    width, height = image_size
    half_height = np.tan(np.radians(VERTICAL_FOV_DEGREES) / 2)
    half_width = half_height * width / height
    flat = np.asarray(landmarks, dtype=float) - (0.5, 0.5, 0.0)
    flat = flat * (2 * half_width, -2 * half_height, 2 * half_width)  # one unit ahead, z away
    middle = flat[:, 2].mean()

    first = _fit(face, flat * (1, 1, -1))[0]
    second = _fit(face, _unproject(flat, middle, first))[0]
    scale = first * second
    _, rotation, translation = _fit(face, _unproject(flat, middle, scale), fixed_scale=True)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def _unproject(flat: np.ndarray, middle: float, scale: float) -> np.ndarray:
    depth = (flat[:, 2] - middle + 1.0) / scale
    return np.stack([flat[:, 0] * depth, flat[:, 1] * depth, -depth], axis=-1)


def _fit(
    face: CanonicalFace, points: np.ndarray, *, fixed_scale: bool = False
) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation (3, 3) and translation (3,) that carry the canonical face onto ``points``."""
    w = face.weights / face.weights.sum()
    source_mean, target_mean = w @ face.vertices, w @ points
    source, target = face.vertices - source_mean, points - target_mean
    u, singular, vt = np.linalg.svd((target * w[:, None]).T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = 1.0 if fixed_scale else float(singular @ signs / (w @ (source**2).sum(axis=1)))
    return scale, rotation, target_mean - scale * rotation @ source_mean


def _fields(data: bytes) -> list[tuple[int, bytes | int]]:
    """(field number, value) pairs of one protocol buffer message."""
    fields: list[tuple[int, bytes | int]] = []
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        value: bytes | int
        if kind == 0:
            value, at = _varint(data, at)
        else:
            if kind == 2:
                size, at = _varint(data, at)
            elif kind in (1, 5):
                size = 8 if kind == 1 else 4
            else:
                raise ValueError(f"wire type {kind}")
            value, at = data[at : at + size], at + size
        fields.append((key >> 3, value))
    return fields


def _bytes(value: bytes | int) -> bytes:
    if isinstance(value, int):
        raise ValueError("a number where a message was expected")
    return value


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value, at
