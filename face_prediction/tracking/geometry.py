"""Rotations as unit quaternions (w, x, y, z) and 3x3 matrices, on whole arrays of frames."""

from __future__ import annotations

import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from face_prediction.tracking.lifting import VERTICAL_FOV_DEGREES
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError


def quaternion_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) wxyz of rotation matrices (..., 3, 3).

    Bar-Itzhack's method: the eigenvector of the largest eigenvalue of a symmetric matrix. It has
    no branches and gives the nearest rotation where the matrix is slightly off.
    """
    m = np.asarray(matrix, dtype=float)
    k = np.zeros((*m.shape[:-2], 4, 4))
    trace = np.trace(m, axis1=-2, axis2=-1)
    k[..., 0, 0] = trace
    k[..., 1:, 1:] = m + np.swapaxes(m, -1, -2) - trace[..., None, None] * np.eye(3)
    vector = np.stack(
        [
            m[..., 2, 1] - m[..., 1, 2],
            m[..., 0, 2] - m[..., 2, 0],
            m[..., 1, 0] - m[..., 0, 1],
        ],
        axis=-1,
    )
    k[..., 0, 1:] = vector
    k[..., 1:, 0] = vector
    _, vectors = np.linalg.eigh(k / 3.0)
    quaternion = vectors[..., :, -1]
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def matrix_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) wxyz."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def continuous_quaternions(quaternion: np.ndarray) -> np.ndarray:
    """Flip signs along the first axis of (T, 4) so that neighbours never differ by a sign."""
    q = np.asarray(quaternion, dtype=float)
    if len(q) < 2:
        return q.copy()
    flips = np.sign(np.sum(q[1:] * q[:-1], axis=-1))
    flips[flips == 0] = 1.0
    return q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def slerp(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) at ``weight`` (N,) in 0..1 on the shorter arcs from first to second."""
    a = np.asarray(first, dtype=float)
    b = np.asarray(second, dtype=float)
    t = np.asarray(weight, dtype=float)[..., None]
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b = np.where(dot < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    # below 1e-6 rad the sine underflows in the quotient, and the chord is the arc
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    blended = np.where(small, 1 - t, np.sin((1 - t) * angle) / sine) * a
    blended = blended + np.where(small, t, np.sin(t * angle) / sine) * b
    return blended / np.linalg.norm(blended, axis=-1, keepdims=True)


def rotation_angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle in radians (...,) between the rotations of unit quaternions (..., 4)."""
    dot = np.abs(np.sum(np.asarray(first) * np.asarray(second), axis=-1))
    return 2 * np.arccos(np.clip(dot, 0.0, 1.0))


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


#: Landmark, its x, y, z in the canonical face in centimetres, and its weight in MediaPipe's fit
#: (``geometry_pipeline_metadata_landmarks.binarypb`` in face_landmarker.task, Apache-2.0), without
#: the eight that move with the mouth: 132, 136, 147, 205 and their mirror images.
RIGID_LANDMARKS = (
    (4, 0.00000, -0.46317, 7.58658, 0.070910),
    (6, 0.00000, 2.47325, 5.78863, 0.032100),
    (10, 0.00000, 8.26178, 4.48153, 0.008447),
    (33, -4.44586, 2.66399, 3.17342, 0.058724),
    (54, -6.27933, 6.61543, 1.42585, 0.007667),
    (67, -3.52396, 8.00598, 3.72916, 0.009078),
    (117, -5.25866, 0.94581, 2.97431, 0.009792),
    (119, -3.30068, 0.86164, 3.87278, 0.014565),
    (121, -1.82073, 1.46795, 4.22412, 0.018591),
    (127, -7.74309, 2.36500, -2.00517, 0.005198),
    (129, -1.78579, -0.97828, 4.85047, 0.120625),
    (133, -1.85643, 2.58524, 3.75790, 0.053286),
    (143, -6.40757, 2.23602, 1.56084, 0.014817),
    (198, -1.24681, 0.23030, 5.68104, 0.025462),
    (263, 4.44586, 2.66399, 3.17342, 0.058724),
    (284, 6.27933, 6.61543, 1.42585, 0.007667),
    (297, 3.52396, 8.00598, 3.72916, 0.009078),
    (346, 5.25866, 0.94581, 2.97431, 0.009792),
    (348, 3.30068, 0.86164, 3.87278, 0.014565),
    (350, 1.82073, 1.46795, 4.22412, 0.018591),
    (356, 7.74309, 2.36500, -2.00517, 0.005198),
    (358, 1.78579, -0.97828, 4.85047, 0.120625),
    (362, 1.85643, 2.58524, 3.75790, 0.053286),
    (372, 6.40757, 2.23602, 1.56084, 0.014817),
    (420, 1.24681, 0.23030, 5.68104, 0.025462),
)


def rigid_face() -> CanonicalFace:
    """The canonical face with weight on its rigid landmarks only; the other vertices are zero."""
    table = np.array(RIGID_LANDMARKS)
    vertices = np.zeros((NUM_LANDMARKS, 3))
    weights = np.zeros(NUM_LANDMARKS)
    indices = table[:, 0].astype(int)
    vertices[indices] = table[:, 1:4] * CENTIMETRE
    weights[indices] = table[:, 4]
    return CanonicalFace(vertices, weights)


def rigid_head_poses(
    landmarks: np.ndarray, valid: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """Poses (T, 4, 4) in metres, camera from head, of landmarks (T, L, 3); NaN where not valid."""
    face = rigid_face()
    poses = np.full((len(landmarks), 4, 4), np.nan)
    for index in np.flatnonzero(valid):
        poses[index] = head_pose_from_landmarks(landmarks[index], image_size, face)
    return poses
