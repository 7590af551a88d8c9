"""Geometry of faces: camera, lifting to metres, rotations, head pose, crops of the image.

Camera model (MediaPipe's, so that landmarks and head pose agree): a pinhole at the origin looking
along -z, x right in the image, y up, principal point in the middle of the image, square pixels,
vertical field of view 63 degrees. It is assumed, not measured: of the real camera nothing is known.

Rotations are unit quaternions (w, x, y, z) or 3x3 matrices, on whole arrays of frames.

Crops are in pixels of the displayed image, x right and y down, 0 at the outer edge of the first
pixel; coordinates in a crop are the same divided by its side, so that the crop spans 0...1.

Legend: T frames, P points, L = 468 landmarks.
"""

from __future__ import annotations

import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.tracking.tracks import NUM_LANDMARKS, Size
from robo_manip_baselines.runs.errors import RequestError

VERTICAL_FOV_DEGREES = 63.0
"""vertical_fov_degrees of the perspective camera in MediaPipe's
``face_geometry_from_landmarks_graph.cc``."""

# fmt: off
LIPS = (
    0, 13, 14, 17, 37, 39, 40, 61, 78, 80, 81, 82, 84, 87, 88, 91, 95, 146, 178, 181,
    185, 191, 267, 269, 270, 291, 308, 310, 311, 312, 314, 317, 318, 321, 324, 375, 402, 405, 409,
    415,
)
# fmt: on
"""The 40 points of MediaPipe's FACEMESH_LIPS; their mean is the mouth centre (paper, IV.B)."""

UPPER_INNER_LIP = 13
LOWER_INNER_LIP = 14

CANONICAL_MOUTH = np.array([0.0, -0.0428505, 0.0494276])
"""Mean of the 40 lip vertices of MediaPipe's canonical face (``canonical_face_model.obj``,
Apache-2.0), metres in the head frame."""

MINIMUM_COSINE = 0.26
"""Below this cosine between the ray and the normal of the mouth's plane (75 degrees) the depth of a
lip seen from the side means nothing; its frame lifts to NaN."""

GEOMETRY_FILE = "geometry_pipeline_metadata_landmarks.binarypb"
CENTIMETRE = 0.01
_ZIP_ERRORS = (zipfile.BadZipFile, struct.error)
_VERTEX_FLOATS = 5  # x, y, z in centimetres, and two texture coordinates

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
"""Landmark, its x, y, z in the canonical face in centimetres, and its weight in MediaPipe's fit
(``geometry_pipeline_metadata_landmarks.binarypb`` in face_landmarker.task, Apache-2.0), without the
eight that move with the mouth: 132, 136, 147, 205 and their mirror images."""


def view_size(image_size: Size, fov: float = VERTICAL_FOV_DEGREES) -> tuple[float, float]:
    """Width and height of the image on the plane one unit ahead of the camera.

    ``fov`` is the vertical field of view in degrees, of a camera of which it is known.
    """
    height = 2 * np.tan(np.radians(fov) / 2)
    return height * image_size[0] / image_size[1], height


def image_rays(
    points: np.ndarray, image_size: Size, fov: float = VERTICAL_FOV_DEGREES
) -> np.ndarray:
    """Directions (..., 3) in the camera frame, scaled to z = -1, of points (..., 2 or 3).

    ``points`` are normalised image coordinates (x right / width, y down / height); ``fov`` as for
    `view_size`.
    """
    width, height = view_size(image_size, fov)
    p = np.asarray(points, dtype=float)
    x = (p[..., 0] - 0.5) * width
    return np.stack([x, (0.5 - p[..., 1]) * height, np.full_like(x, -1.0)], axis=-1)


def points_on_mouth_plane(
    points: np.ndarray, head_pose: np.ndarray, image_size: Size
) -> np.ndarray:
    """Intersections (T, P, 3) m of the rays of image points (T, P, 2 or 3) with the mouth's plane.

    The plane goes through the canonical mouth centre, carried by ``head_pose`` (T, 4, 4), and is
    normal to the head's z axis; it turns with the head, so that a lip pair seen obliquely keeps
    its length. Frames in which the plane is seen edge-on give NaN.
    """
    rays = image_rays(points, image_size)
    rotation = head_pose[:, :3, :3]
    centre = rotation @ CANONICAL_MOUTH + head_pose[:, :3, 3]  # (T, 3)
    normal = rotation[:, :, 2]  # (T, 3)
    along = np.einsum("tpi,ti->tp", rays, normal)
    cosine = np.abs(along) / np.linalg.norm(rays, axis=-1)
    distance = np.einsum("ti,ti->t", centre, normal)[:, None]
    depth = np.where(cosine > MINIMUM_COSINE, distance / np.where(along == 0, 1.0, along), np.nan)
    return rays * depth[..., None]


def mouth_centres(landmarks: np.ndarray, head_pose: np.ndarray, image_size: Size) -> np.ndarray:
    """Mouth centres (T, 3) in metres, camera frame: mean of the 40 lip points on their plane.

    ``landmarks`` are (T, 468, 2 or 3) normalised image coordinates, ``head_pose`` (T, 4, 4) metres,
    camera from head.
    """
    return points_on_mouth_plane(landmarks[:, list(LIPS)], head_pose, image_size).mean(axis=1)


def jaw_openings(landmarks: np.ndarray, head_pose: np.ndarray, image_size: Size) -> np.ndarray:
    """Distances (T,) in metres between the inner lips (13 and 14) on the mouth's plane."""
    lips = landmarks[:, [UPPER_INNER_LIP, LOWER_INNER_LIP]]
    pair = points_on_mouth_plane(lips, head_pose, image_size)
    return np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)


def lift_landmarks(
    landmarks: np.ndarray, valid: np.ndarray, image_size: Size
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mouth centre (T, 3) m, head orientation (T, 4) wxyz, jaw opening (T,) m; NaN if not valid.

    ``landmarks`` (T, 468, 3) are normalised image coordinates. The head pose is that of
    `rigid_head_poses`.
    """
    landmarks = landmarks.astype(np.float64)
    pose = rigid_head_poses(landmarks, valid, image_size)
    orientation = np.full((len(valid), 4), np.nan)
    orientation[valid] = quaternion_from_matrix(pose[valid, :3, :3])
    mouth = mouth_centres(landmarks, pose, image_size)
    return mouth, orientation, jaw_openings(landmarks, pose, image_size)


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
    for i, (row, column) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        k[..., 0, i] = k[..., i, 0] = m[..., row, column] - m[..., column, row]
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
            fields = _protobuf_fields(archive.read(GEOMETRY_FILE))
        # GeometryPipelineMetadata: 1 canonical_mesh, 2 procrustes_landmark_basis (id, weight);
        # Mesh3d: 3 vertex_buffer
        mesh = _protobuf_fields(next(value for key, value in fields if key == 1))
        floats = [struct.unpack("<f", value)[0] for key, value in mesh if key == 3]
        vertices = np.array(floats).reshape(-1, _VERTEX_FLOATS)[:, :3] * CENTIMETRE
        weights = np.zeros(len(vertices))
        for basis in (dict(_protobuf_fields(value)) for key, value in fields if key == 2):
            weights[basis[1]] = struct.unpack("<f", basis[2])[0]
    except (OSError, LookupError, TypeError, ValueError, StopIteration, *_ZIP_ERRORS) as error:
        raise RequestError(
            f"{model}: not a face landmarker model ({type(error).__name__}: {error})"
        ) from None
    return CanonicalFace(vertices, weights)


def _protobuf_fields(data: bytes) -> list[tuple[int, Any]]:
    """(field number, value) pairs of one protocol buffer message; values are bytes or integers."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    fields: list[tuple[int, Any]] = []
    while at < len(data):
        key = varint()
        if (wire := key & 7) == 0:
            fields.append((key >> 3, varint()))
            continue
        if wire not in (1, 2, 5):
            raise ValueError(f"wire type {wire}")
        size = varint() if wire == 2 else {1: 8, 5: 4}[wire]
        fields.append((key >> 3, data[at : at + size]))
        at += size
    return fields


def rigid_face() -> CanonicalFace:
    """The canonical face with weight on its rigid landmarks only; the other vertices are zero."""
    table = np.array(RIGID_LANDMARKS)
    vertices, weights = np.zeros((NUM_LANDMARKS, 3)), np.zeros(NUM_LANDMARKS)
    indices = table[:, 0].astype(int)
    vertices[indices] = table[:, 1:4] * CENTIMETRE
    weights[indices] = table[:, 4]
    return CanonicalFace(vertices, weights)


def rigid_head_poses(landmarks: np.ndarray, valid: np.ndarray, image_size: Size) -> np.ndarray:
    """Poses (T, 4, 4) in metres, camera from head, of landmarks (T, L, 3); NaN where not valid."""
    face = rigid_face()
    poses = np.full((len(landmarks), 4, 4), np.nan)
    for index in np.flatnonzero(valid):
        poses[index] = head_pose_from_landmarks(landmarks[index], image_size, face)
    return poses


def head_pose_from_landmarks(
    landmarks: np.ndarray, image_size: Size, face: CanonicalFace
) -> np.ndarray:
    """Pose (4, 4) in metres, camera from head, of landmarks (L, 3) normalised to the image.

    The relative depth of the landmarks is on the scale of their x, so the whole face has one free
    scale, found in two rounds: first without perspective, then with it.
    """
    flat = image_rays(landmarks, image_size)  # one unit ahead
    flat[:, 2] = np.asarray(landmarks, dtype=float)[:, 2] * view_size(image_size)[0]  # z away
    relative = flat[:, 2] - flat[:, 2].mean() + 1.0

    def unproject(scale: float) -> np.ndarray:
        depth = relative / scale
        return np.stack([flat[:, 0] * depth, flat[:, 1] * depth, -depth], axis=-1)

    first = _fit(face, flat * (1, 1, -1))[0]
    scale = first * _fit(face, unproject(first))[0]
    pose = np.eye(4)
    _, pose[:3, :3], pose[:3, 3] = _fit(face, unproject(scale), fixed_scale=True)
    return pose


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


@dataclass(frozen=True)
class Crop:
    """A square of the image, or beyond: left and top edge and side, whole pixels."""

    left: int
    top: int
    side: int

    def normalise(self, landmarks: np.ndarray, image_size: Size) -> np.ndarray:
        """Crop coordinates (..., 3) of ``landmarks`` (..., 3), normalised image coordinates.

        Depth, given in image widths, becomes crop sides.
        """
        scale = np.array([image_size[0], image_size[1], image_size[0]], dtype=np.float64)
        offset = np.array([self.left, self.top, 0.0])
        return (np.asarray(landmarks, dtype=np.float64) * scale - offset) / self.side

    def region(self, image: np.ndarray) -> np.ndarray:
        """The part (side, side, 3) of ``image`` (H, W, 3) under the crop, black outside it."""
        rows = np.clip([self.top, self.top + self.side], 0, image.shape[0])
        columns = np.clip([self.left, self.left + self.side], 0, image.shape[1])
        part = image[rows[0] : rows[1], columns[0] : columns[1]]
        if part.shape[:2] == (self.side, self.side):
            return part
        whole = np.zeros((self.side, self.side, 3), dtype=np.uint8)
        top, left = rows[0] - self.top, columns[0] - self.left
        whole[top : top + part.shape[0], left : left + part.shape[1]] = part
        return whole

    def cut(self, image: np.ndarray, size: int) -> np.ndarray:
        """`region` of ``image`` (H, W, 3) scaled to (size, size, 3)."""
        import cv2  # only images need it

        # areas average when shrinking, which leaves no false patterns; lines join when enlarging
        method = cv2.INTER_AREA if self.side > size else cv2.INTER_LINEAR
        scaled = cv2.resize(self.region(image), (size, size), interpolation=method)
        return np.asarray(scaled, dtype=np.uint8)

    def padding(self, image_size: Size) -> float:
        """Share of the crop's area that lies outside the image, 0...1."""
        width = min(self.left + self.side, image_size[0]) - max(self.left, 0)
        height = min(self.top + self.side, image_size[1]) - max(self.top, 0)
        return 1.0 - max(width, 0) * max(height, 0) / self.side**2


def crop_around(landmarks: np.ndarray, image_size: Size, margin: float) -> Crop:
    """The crop around all faces of a stretch of frames.

    Its side is (1 + 2 margin) times the longer side of the box around every landmark of every
    frame, and its middle that of the box. Where the image is large enough it is moved inside.
    ``landmarks`` are (T, L, 2 or 3) normalised image coordinates, all finite.
    """
    size = np.array(image_size, dtype=np.float64)
    points = np.asarray(landmarks, dtype=np.float64)[..., :2].reshape(-1, 2) * size
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(int(np.ceil((high - low).max() * (1 + 2 * margin))), 1)
    corner = np.round((low + high) / 2 - side / 2).astype(int)
    room = np.array(image_size) - side
    corner = np.where(room >= 0, np.clip(corner, 0, np.maximum(room, 0)), corner)
    return Crop(int(corner[0]), int(corner[1]), side)


def image_points(crop: Crop, points: np.ndarray, image_size: Size) -> np.ndarray:
    """Crop coordinates (..., 2) as normalised image coordinates (..., 2)."""
    corner = np.array([crop.left, crop.top], dtype=np.float64)
    return (np.asarray(points, dtype=np.float64) * crop.side + corner) / image_size
