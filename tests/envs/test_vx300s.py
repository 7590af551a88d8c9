"""The arm's kinematics, limits, masses and inertias against the published model, in NumPy."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell import vx300s
from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, build_cell
from robo_manip_baselines.observation import ARM_JOINTS

PI = math.pi
FULL_TURN = PI - 0.00001

# The manufacturer's URDF (Interbotix/interbotix_ros_manipulators, vx300s.urdf.xacro), by hand:
# joint, origin in the parent link (m; every rpy is zero), axis, limits (rad).
CHAIN = (
    ("waist", (0, 0, 0.079), (0, 0, 1), (-FULL_TURN, FULL_TURN)),
    ("shoulder", (0, 0, 0.04805), (0, 1, 0), (math.radians(-106), math.radians(72))),
    ("elbow", (0.05955, 0, 0.3), (0, 1, 0), (math.radians(-101), math.radians(92))),
    ("forearm_roll", (0.2, 0, 0), (1, 0, 0), (-FULL_TURN, FULL_TURN)),
    ("wrist_angle", (0.1, 0, 0), (0, 1, 0), (math.radians(-107), math.radians(128))),
    ("wrist_rotate", (0.069744, 0, 0), (1, 0, 0), (-FULL_TURN, FULL_TURN)),
)
# ee_arm, ee_bar and ee_gripper: fixed joints ahead of the wrist_rotate frame.
GRIPPER = (0.042825 + 0.025875 + 0.0385, 0, 0)

# link, mass (kg), centre of mass (mm), rpy of the inertial frame (quarter turns), and in that frame
# ixx iyy izz ixy ixz iyz (kg mm²)
INERTIALS = """
base          0.969034 -53.4774  -0.562575 20.5961 0 0 1   6024   1700   7162   47.13   3.851 -84.15
shoulder      0.798614 0.259233 -0.0033552 11.6129 0 0 1  938.8   1138   1201  -0.001 -0.0191 5.9568
upper_arm     0.792592  20.6949  0.0000004 226.459 0 0 1   8925   8937  935.7       0       0   1201
upper_forearm 0.322228  105.723          0       0 0 0 0  152.4   1342   1441  -18.83 -8.4064 1.2564
lower_forearm 0.414823  51.3477    6.80462       0 2 0 0  175.3  526.9  591.1  -85.28       0      0
wrist         0.115395   46.743 -0.0076652  10.565 0 0 1  46.31  45.14   52.7  0.0195  0.0023 4.2002
gripper       0.097666   23.001          0  11.523 0 0 1  32.68  24.36  21.19       0       0 0.2785
gripper_prop  0.008009    2.378  0.0000285       0 0 0 1 2.0386 4.2979 2.3796       0  0.6559      0
gripper_bar   0.150986    6.794 -0.0004272  -0.776 0 0 1  78.95  328.3  309.5 -0.0012  0.1341 1.7465
left_finger   0.034796   17.344    -6.0692       0 2 2 1  24.33  12.55  14.17 -2.4004       0      0
right_finger  0.034796   17.344     6.0692       0 0 2 1  24.33  12.55  14.17  2.4001       0      0
""".strip().splitlines()


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' formula, (3, 3)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def published_gripper(angles: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and orientation (3, 3) of ee_gripper_link, world frame."""
    position, orientation = base, np.eye(3)
    if base[0] > 0:  # the right arm faces the left one
        orientation = rotation((0, 0, 1), PI)
    for (_, origin, axis, _), angle in zip(CHAIN, angles, strict=True):
        position = position + orientation @ np.array(origin)
        orientation = orientation @ rotation(axis, angle)
    return position + orientation @ np.array(GRIPPER), orientation


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_cell().compile()


@pytest.mark.parametrize("arm", ["left", "right"])
def test_gripper_pose_agrees_with_the_published_chain(model: mujoco.MjModel, arm: str) -> None:
    data = mujoco.MjData(model)
    rng = np.random.default_rng(20)
    low, high = np.array([limits for *_, limits in CHAIN]).T
    base = np.array([-0.469 if arm == "left" else 0.469, 0.5, 0.0])
    address = [model.joint(f"{arm}/{joint}").qposadr[0] for joint, *_ in CHAIN]
    for angles in rng.uniform(low, high, (500, 6)):
        data.qpos[address] = angles
        mujoco.mj_kinematics(model, data)
        site = data.site(f"{arm}/gripper")
        position, orientation = published_gripper(angles, base)
        # 1 mm and 0.5 degrees would do; the same figures must agree to rounding.
        np.testing.assert_allclose(site.xpos, position, atol=1e-9)
        np.testing.assert_allclose(site.xmat.reshape(3, 3), orientation, atol=1e-9)


def test_joint_limits_are_the_published_ones(model: mujoco.MjModel) -> None:
    assert tuple(joint for joint, *_ in CHAIN) == ARM_JOINTS
    for arm in ARM_BASES:
        for joint, _, _, limits in CHAIN:
            joint_range = model.joint(f"{arm}/{joint}").range
            for found in (joint_range, model.actuator(f"{arm}/{joint}").ctrlrange):
                assert tuple(found) == pytest.approx(limits, abs=1e-10)
        fingers = (vx300s.FINGER_CLOSED, vx300s.FINGER_OPEN)
        assert fingers == (0.021, 0.057)
        assert tuple(model.joint(f"{arm}/left_finger").range) == fingers
        assert tuple(model.joint(f"{arm}/right_finger").range) == (-0.057, -0.021)
        assert tuple(model.actuator(f"{arm}/gripper").ctrlrange) == fingers


def test_home_pose_is_within_the_limits() -> None:
    for angle, (*_, (low, high)) in zip(vx300s.HOME_QPOS, CHAIN, strict=True):
        assert low < angle < high


@pytest.mark.parametrize("row", INERTIALS, ids=lambda row: row.split()[0])
def test_masses_and_inertias_are_the_published_ones(model: mujoco.MjModel, row: str) -> None:
    link, *figures = row.split()
    mass, *numbers = map(float, figures)
    centre, turns, (xx, yy, zz, xy, xz, yz) = numbers[:3], numbers[3:6], numbers[6:]
    tensor = 1e-6 * np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    roll, pitch, yaw = np.array(turns) * PI / 2  # about URDF's fixed axes
    frame = rotation((0, 0, 1), yaw) @ rotation((0, 1, 0), pitch) @ rotation((1, 0, 0), roll)
    expected = frame @ tensor @ frame.T
    for arm in ARM_BASES:
        body = model.body(f"{arm}/{link}_link")
        assert body.mass[0] == pytest.approx(mass, rel=1e-9)
        np.testing.assert_allclose(body.ipos, 1e-3 * np.array(centre), atol=1e-12)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, body.iquat)
        axes = axes.reshape(3, 3)
        found = axes @ np.diag(body.inertia) @ axes.T
        # Off-diagonal figures are rounded to five digits in the XML.
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_no_body_has_a_mass_that_was_not_published(model: mujoco.MjModel) -> None:
    published = sum(float(row.split()[1]) for row in INERTIALS)
    assert model.body_mass.sum() == pytest.approx(2 * published, rel=1e-9)


def test_pads_meet_when_closed_and_are_72_mm_apart_when_open(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    left, right = (model.geom(f"right/{side}_finger_pad") for side in ("left", "right"))
    for position, gap in ((0.021, 0.0), (0.057, 0.072)):
        data.joint("right/left_finger").qpos = position
        data.joint("right/right_finger").qpos = -position
        mujoco.mj_kinematics(model, data)
        centres = np.linalg.norm(data.geom(left.id).xpos - data.geom(right.id).xpos)
        assert centres - left.size[1] - right.size[1] == pytest.approx(gap, abs=1e-9)


def test_pads_are_centred_on_the_gripper_site_and_the_tips_end_behind_the_cubes_face(
    model: mujoco.MjModel,
) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    site = data.site("right/gripper")
    to_site = site.xmat.reshape(3, 3).T
    for side in ("left", "right"):
        pad = model.geom(f"right/{side}_finger_pad")
        ahead, _, above = to_site @ (data.geom(pad.id).xpos - site.xpos)
        assert (ahead, above) == pytest.approx((0, 0), abs=1e-9)
        assert pad.size[2] == pytest.approx(0.01)  # 2 cm thick: fits under a cube's top, 4 cm
        boxes = np.flatnonzero(model.geom_bodyid == pad.bodyid[0])
        assert np.all(model.geom_type[boxes] == mujoco.mjtGeom.mjGEOM_BOX)
        tip = max(
            (to_site @ (data.geom_xpos[box] - site.xpos))[0]
            + np.abs(to_site @ data.geom_xmat[box].reshape(3, 3))[0] @ model.geom_size[box]
            for box in boxes
        )
        assert 0.015 < tip < 0.02  # half of the 4 cm cube is 0.02
