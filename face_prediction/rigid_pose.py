"""Head pose from the part of the face that keeps still when the mouth moves.

MediaPipe fits its canonical face to 33 landmarks, among them the corners of the jaw and points on
the cheeks. When the mouth opens these go down, the face looks longer, and so nearer: on the webcam
clips measured, half a millimetre for every millimetre of opening. The motion that a robot follows
is therefore lifted with a pose fitted to the 25 landmarks of brow, eyes, temples and nose only, by
the same method (``face_geometry``) and with the same weights.

Legend: T frames, L = 468 landmarks.
"""

from __future__ import annotations

import numpy as np

from face_prediction.face_geometry import CENTIMETRE, CanonicalFace, head_pose_from_landmarks
from face_prediction.tracks import NUM_LANDMARKS

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
