"""Measure a 468-vertex face surface with a jaw from ``FaceTrack`` files of real faces.

Legend: T frames, V = 468 vertices, H head frame (metres; x the viewer's right, y up, z out of
the face; the orientation of MediaPipe's canonical face), w a vertex's share in the jaw's rotation.

The surface is the mean of real faces: every frame is lifted to metres with its head pose, aligned
to the running mean over the parts of a face that do not move with expression, regressed on the
jaw opening, and read off where the lips touch. Clips of one subject are pooled first, so each
person counts once.
"""

from __future__ import annotations

import numpy as np

# FaceLandmarker's own camera: vertical field of view 63 degrees, image plane one unit ahead
# (mediapipe, modules/face_geometry, Environment of the face landmarker graph).
_VERTICAL_FOV = np.deg2rad(63.0)

# Mean of the 468 vertices of the canonical face that FaceLandmarker's pose is fitted to (metres,
# head frame; geometry_pipeline_metadata_landmarks.binarypb inside face_landmarker.task).
_CANONICAL_MEAN = np.array([0.0, -0.00676, 0.04159])

UPPER_INNER_LIP, LOWER_INNER_LIP = 13, 14


def metric_landmarks(landmarks: np.ndarray, pose: np.ndarray, image_size: np.ndarray) -> np.ndarray:
    """Lift image landmarks to metres in the head frame.

    FaceLandmarker's z is a relative depth on the scale of x. Its geometry pipeline turns it into
    metres by one number a frame, the mean distance of the face, which the head pose gives back.

    Args:
        landmarks: (T, V, 3) normalised image coordinates, y down, z toward the scene.
        pose: (T, 4, 4) camera-from-head, metres, camera looking along -z.
        image_size: (width, height) in pixels.

    Returns:
        (T, V, 3) metres, head frame.
    """
    width, height = image_size
    half_height = np.tan(_VERTICAL_FOV / 2)
    half_width = half_height * width / height
    rotation, translation = pose[:, :3, :3], pose[:, :3, 3]
    distance = -(rotation @ _CANONICAL_MEAN + translation)[:, 2]
    relative = landmarks[:, :, 2] * 2 * half_width
    depth = (1 + relative - relative.mean(axis=1, keepdims=True)) * distance[:, None]
    camera = np.stack(
        [
            (2 * landmarks[:, :, 0] - 1) * half_width * depth,
            (1 - 2 * landmarks[:, :, 1]) * half_height * depth,
            -depth,
        ],
        axis=-1,
    )
    return (camera - translation[:, None]) @ rotation
