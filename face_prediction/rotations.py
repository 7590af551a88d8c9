"""Rotations as unit quaternions (w, x, y, z) and 3x3 matrices, on whole arrays of frames."""

from __future__ import annotations

import numpy as np


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
