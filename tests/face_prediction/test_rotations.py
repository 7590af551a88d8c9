"""Quaternions against SciPy's."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from face_prediction.tracking.geometry import (
    continuous_quaternions,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_angle,
    slerp,
)

RANDOM = Rotation.random(200, rng=np.random.default_rng(0))
#: half turns, where formulas with branches lose their signs
HALF_TURNS = Rotation.from_rotvec(np.pi * np.eye(3))


def same_rotation(first: np.ndarray, second: np.ndarray) -> None:
    np.testing.assert_allclose(np.abs(np.sum(first * second, axis=-1)), 1.0, atol=1e-12)


def test_matrix_to_quaternion_and_back() -> None:
    for rotation in (RANDOM, HALF_TURNS):
        quaternion = quaternion_from_matrix(rotation.as_matrix())
        same_rotation(quaternion, rotation.as_quat(scalar_first=True))
        np.testing.assert_allclose(
            matrix_from_quaternion(quaternion), rotation.as_matrix(), atol=1e-12
        )


def test_slerp_against_scipy() -> None:
    first, second = RANDOM[:50], RANDOM[50:100]
    for weight in (0.0, 0.2, 0.5, 1.0):
        got = slerp(
            first.as_quat(scalar_first=True),
            -second.as_quat(scalar_first=True),  # a sign must not matter
            np.full(50, weight),
        )
        for index in range(50):
            both = Rotation.concatenate([first[index], second[index]])
            expected = Slerp([0, 1], both)(weight).as_quat(scalar_first=True)
            same_rotation(got[index], expected)


def test_slerp_of_nearly_equal_rotations_is_finite() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(slerp(q, q, np.array([0.3])), q)


def test_angle_against_scipy() -> None:
    first, second = RANDOM[:100], RANDOM[100:]
    expected = (first.inv() * second).magnitude()
    got = rotation_angle(first.as_quat(scalar_first=True), second.as_quat(scalar_first=True))
    np.testing.assert_allclose(got, expected, atol=1e-7)


def test_continuous_quaternions_never_flip() -> None:
    turn = Rotation.from_euler("y", np.linspace(0, 700, 100)[:, None], degrees=True)
    quaternion = turn.as_quat(scalar_first=True)
    flips = np.random.default_rng(3).choice([-1.0, 1.0], 100)
    smooth = continuous_quaternions(quaternion * flips[:, None])
    assert np.all(np.sum(smooth[1:] * smooth[:-1], axis=1) > 0.9)
    same_rotation(smooth, quaternion)
