"""Inverse kinematics against the forward kinematics of the whole cell."""

from __future__ import annotations

import itertools

import mink
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE, build_cell
from robo_manip_baselines.envs.mujoco.cell.vx300s import HOME_QPOS
from robo_manip_baselines.envs.mujoco.expert.kinematics import (
    ORIENTATION_TOLERANCE,
    POSITION_TOLERANCE,
    ArmKinematics,
)
from robo_manip_baselines.envs.mujoco.expert.phases import level_at
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.face.synthetic import REACH
from robo_manip_baselines.envs.mujoco.tasks.face_env import FACE_OFFSET
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import INSERTION, STANDOFF, WITHDRAWAL
from robo_manip_baselines.observation.spec import ARM_JOINTS

from .test_vx300s import CHAIN

LIMITS = np.array([limits for *_, limits in CHAIN])


@pytest.fixture(scope="module", params=["left", "right"])
def arm(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def cell_pose(arm: str, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the gripper site in the compiled cell: position and rotation matrix."""
    model = build_cell().compile()
    data = mujoco.MjData(model)
    for joint, angle in zip(ARM_JOINTS, joints, strict=True):
        data.joint(f"{arm}/{joint}").qpos = angle
    mujoco.mj_kinematics(model, data)
    site = data.site(f"{arm}/gripper")
    return site.xpos.copy(), site.xmat.reshape(3, 3).copy()


def test_forward_is_that_of_the_cell(arm: str) -> None:
    kinematics = ArmKinematics(arm)
    rng = np.random.default_rng(0)
    for joints in rng.uniform(*LIMITS.T, (5, 6)):
        position, rotation = cell_pose(arm, joints)
        pose = kinematics.forward(joints)
        np.testing.assert_allclose(pose.translation(), position, atol=1e-9)
        np.testing.assert_allclose(pose.rotation().as_matrix(), rotation, atol=1e-9)


def test_inverse_finds_nearby_poses(arm: str) -> None:
    kinematics = ArmKinematics(arm)
    rng = np.random.default_rng(1)
    for _ in range(50):
        start = np.array(HOME_QPOS) + rng.uniform(-0.2, 0.2, 6)
        target = kinematics.forward(start + rng.uniform(-0.2, 0.2, 6))
        found = kinematics.forward(kinematics.inverse(target, start))
        error = target.minus(found)
        assert np.linalg.norm(error[:3]) < POSITION_TOLERANCE
        assert np.linalg.norm(error[3:]) < ORIENTATION_TOLERANCE


def test_out_of_reach_stays_within_the_limits() -> None:
    kinematics = ArmKinematics("right")
    joints = kinematics.inverse(level(np.array([-2.0, 0.5, 0.3])), np.array(HOME_QPOS))
    assert np.isfinite(joints).all()
    assert (joints >= LIMITS[:, 0] - 1e-6).all()
    assert (joints <= LIMITS[:, 1] + 1e-6).all()


def test_every_start_and_every_shipped_segment_is_within_reach() -> None:
    """A level gripper reaches the mouth wherever an episode may take it.

    All places that a mouth can be at: the hull of all displacements of all segments, plus every
    offset. Where the corners of that hull are in reach of a straight way, so is what lies between.
    """
    library = MotionLibrary.load()
    outermost = [
        hull(library.segment(run, start).displacement)
        for run, count in enumerate(library.starts())
        for start in range(int(count))
    ]
    offsets = np.array(list(itertools.product((-FACE_OFFSET, FACE_OFFSET), repeat=3)))
    corners = hull((hull(np.concatenate(outermost))[:, None] + offsets).reshape(-1, 3))
    kinematics = ArmKinematics("right")
    ready = MOUTH_BASE + STANDOFF
    start = np.array(HOME_QPOS)
    home = kinematics.forward(start).translation()
    for share in np.linspace(0, 1, 10):
        start = kinematics.inverse(level((1 - share) * home + share * ready), start)
    for corner in corners:
        joints = start
        for share in np.linspace(0, 1, 10):
            target = level((1 - share) * ready + share * (MOUTH_BASE + corner))
            joints = kinematics.inverse(target, joints)
        error = target.minus(kinematics.forward(joints))
        assert np.linalg.norm(error[:3]) < 1e-3, corner  # m, a tenth of the task's tolerance
        assert np.linalg.norm(error[3:]) < 1e-2, corner  # rad


@pytest.mark.parametrize("corner", list(itertools.product((-1.0, 1.0), repeat=3)))
def test_every_corner_that_a_computed_motion_may_take_the_mouth_to_is_within_reach(
    corner: tuple[float, float, float],
) -> None:
    """At the lips, and in front of them where the servo starts to wait and withdraws to."""
    kinematics, joints = ArmKinematics("right"), np.array(HOME_QPOS)
    mouth = (FACE_OFFSET + REACH) * np.array(corner)
    for distance in (WITHDRAWAL, INSERTION):
        for share in np.linspace(0, 1, 8):
            target = level(MOUTH_BASE + distance + share * mouth)
            joints = kinematics.inverse(target, joints)
        error = target.minus(kinematics.forward(joints))
        assert np.linalg.norm(error[:3]) < 1e-3  # m, a tenth of the task's tolerance
        assert np.linalg.norm(error[3:]) < 1e-2  # rad


def level(position: np.ndarray) -> mink.SE3:
    return mink.SE3.from_rotation_and_translation(level_at(position), position)


def hull(points: np.ndarray) -> np.ndarray:
    return points[ConvexHull(points, qhull_options="QJ").vertices]
