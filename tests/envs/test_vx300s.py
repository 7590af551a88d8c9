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

# link, mass, centre of mass, rpy of the inertial frame, (ixx iyy izz ixy ixz iyz) in that frame
INERTIALS = (
    (
        "base_link",
        0.969034,
        (-0.0534774000, -0.0005625750, 0.0205961000),
        (0, 0, PI / 2),
        (0.0060240000, 0.0017000000, 0.0071620000, 0.0000471300, 0.0000038510, -0.0000841500),
    ),
    (
        "shoulder_link",
        0.798614,
        (0.0002592330, -0.0000033552, 0.0116129000),
        (0, 0, PI / 2),
        (0.0009388000, 0.0011380000, 0.0012010000, -0.0000000010, -0.0000000191, 0.0000059568),
    ),
    (
        "upper_arm_link",
        0.792592,
        (0.0206949000, 0.0000000004, 0.2264590000),
        (0, 0, PI / 2),
        (0.0089250000, 0.0089370000, 0.0009357000, 0, 0, 0.0012010000),
    ),
    (
        "upper_forearm_link",
        0.322228,
        (0.105723, 0, 0),
        (0, 0, 0),
        (0.0001524000, 0.0013420000, 0.0014410000, -0.0000188300, -0.0000084064, 0.0000012564),
    ),
    (
        "lower_forearm_link",
        0.414823,
        (0.0513477000, 0.0068046200, 0),
        (PI, 0, 0),
        (0.0001753000, 0.0005269000, 0.0005911000, -0.0000852800, 0, 0),
    ),
    (
        "wrist_link",
        0.115395,
        (0.0467430000, -0.0000076652, 0.0105650000),
        (0, 0, PI / 2),
        (0.0000463100, 0.0000451400, 0.0000527000, 0.0000000195, 0.0000000023, 0.0000042002),
    ),
    (
        "gripper_link",
        0.097666,
        (0.0230010000, 0, 0.0115230000),
        (0, 0, PI / 2),
        (0.0000326800, 0.0000243600, 0.0000211900, 0, 0, 0.0000002785),
    ),
    (
        "gripper_prop_link",
        0.008009,
        (0.0023780000, 0.0000000285, 0),
        (0, 0, PI / 2),
        (0.0000020386, 0.0000042979, 0.0000023796, 0, 0.0000006559, 0),
    ),
    (
        "gripper_bar_link",
        0.150986,
        (0.0067940000, -0.0000004272, -0.0007760000),
        (0, 0, PI / 2),
        (0.0000789500, 0.0003283000, 0.0003095000, -0.0000000012, 0.0000001341, 0.0000017465),
    ),
    (
        "left_finger_link",
        0.034796,
        (0.0173440000, -0.0060692000, 0),
        (PI, PI, PI / 2),
        (0.0000243300, 0.0000125500, 0.0000141700, -0.0000024004, 0, 0),
    ),
    (
        "right_finger_link",
        0.034796,
        (0.0173440000, 0.0060692000, 0),
        (0, PI, PI / 2),
        (0.0000243300, 0.0000125500, 0.0000141700, 0.0000024001, 0, 0),
    ),
)


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' formula, (3, 3)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def from_rpy(rpy: tuple[float, float, float]) -> np.ndarray:
    """URDF's fixed-axis roll, pitch, yaw, (3, 3)."""
    roll, pitch, yaw = rpy
    return rotation((0, 0, 1), yaw) @ rotation((0, 1, 0), pitch) @ rotation((1, 0, 0), roll)


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


@pytest.mark.parametrize("inertial", INERTIALS, ids=lambda inertial: inertial[0])
def test_masses_and_inertias_are_the_published_ones(model: mujoco.MjModel, inertial: tuple) -> None:
    name, mass, centre, rpy, (xx, yy, zz, xy, xz, yz) = inertial
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    frame = from_rpy(rpy)
    expected = frame @ tensor @ frame.T
    for arm in ARM_BASES:
        body = model.body(f"{arm}/{name}")
        assert body.mass[0] == pytest.approx(mass, rel=1e-9)
        np.testing.assert_allclose(body.ipos, centre, atol=1e-12)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, body.iquat)
        axes = axes.reshape(3, 3)
        found = axes @ np.diag(body.inertia) @ axes.T
        # Off-diagonal figures are rounded to five digits in the XML.
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_no_body_has_a_mass_that_was_not_published(model: mujoco.MjModel) -> None:
    published = sum(mass for _, mass, *_ in INERTIALS)
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
