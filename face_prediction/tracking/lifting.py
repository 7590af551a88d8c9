"""From image landmarks and head pose to metres: the camera model, the mouth centre, the jaw.

Camera model (MediaPipe's, so that landmarks and head pose agree): a pinhole at the origin looking
along -z, x right in the image, y up, principal point in the middle of the image, square pixels,
vertical field of view 63 degrees. It is assumed, not measured: of the real camera nothing is known.

Legend: T frames, P points.
"""

from __future__ import annotations

import numpy as np

#: ``face_geometry_from_landmarks_graph.cc`` of MediaPipe: vertical_fov_degrees of its
#: perspective camera.
VERTICAL_FOV_DEGREES = 63.0

#: The 40 points of MediaPipe's FACEMESH_LIPS; their mean is the mouth centre (paper, IV.B).
# fmt: off
LIPS = (
    0, 13, 14, 17, 37, 39, 40, 61, 78, 80, 81, 82, 84, 87, 88, 91, 95, 146, 178, 181,
    185, 191, 267, 269, 270, 291, 308, 310, 311, 312, 314, 317, 318, 321, 324, 375, 402, 405, 409,
    415,
)
# fmt: on
UPPER_INNER_LIP = 13
LOWER_INNER_LIP = 14

#: Mean of the 40 lip vertices of MediaPipe's canonical face (``canonical_face_model.obj``,
#: Apache-2.0), metres in the head frame.
CANONICAL_MOUTH = np.array([0.0, -0.0428505, 0.0494276])

#: Below this cosine between the ray and the mouth's plane a lip seen from the side has no
#: meaningful depth (75 degrees); its frame lifts to NaN.
MINIMUM_COSINE = 0.26


def image_rays(points: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Directions (..., 3) in the camera frame, scaled to z = -1, of points (..., 2 or 3).

    ``points`` are normalised image coordinates (x right / width, y down / height).
    """
    width, height = image_size
    half_height = np.tan(np.radians(VERTICAL_FOV_DEGREES) / 2)
    half_width = half_height * width / height
    p = np.asarray(points, dtype=float)
    x = (2 * p[..., 0] - 1) * half_width
    y = (1 - 2 * p[..., 1]) * half_height
    return np.stack([x, y, np.full_like(x, -1.0)], axis=-1)


def points_on_mouth_plane(
    points: np.ndarray, head_pose: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """Where the rays of image points (T, P, 2 or 3) meet the plane of the mouth, (T, P, 3) metres.

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


def mouth_centres(
    landmarks: np.ndarray, head_pose: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """Mouth centres (T, 3) in metres, camera frame: mean of the 40 lip points on their plane.

    Args:
        landmarks: (T, 468, 2 or 3) normalised image coordinates.
        head_pose: (T, 4, 4) metres, camera from head.
        image_size: (width, height) in pixels.
    """
    return points_on_mouth_plane(landmarks[:, list(LIPS)], head_pose, image_size).mean(axis=1)


def jaw_openings(
    landmarks: np.ndarray, head_pose: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """Distances (T,) in metres between the inner lips (13 and 14) on the mouth's plane."""
    pair = points_on_mouth_plane(
        landmarks[:, [UPPER_INNER_LIP, LOWER_INNER_LIP]], head_pose, image_size
    )
    return np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
