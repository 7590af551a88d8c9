"""Motion of the arms, grasping and holding."""

from __future__ import annotations

from itertools import pairwise

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, CUBE_SIZE
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.observation.spec import ARM_JOINTS

SUBSTEPS = 10  # 50 Hz control of 2 ms physics
CONTROL_PERIOD = 0.02  # s

# Joint angles (rad) of a feeding by the right arm, the cube at (0.1, 0.5): above the cube, at it
# (the gripper 60 degrees down, its tips clear of the table), lifted, levelled along -x, before the
# mouth, beside the mouth.
ABOVE = (0.0, -0.1679, 0.8549, 0.0, 0.3602, 0.0)
AT_CUBE = (0.0, 0.1285, 0.7861, 0.0, 0.1325, 0.0)
LIFTED = (0.0, -0.6661, 0.7348, 0.0, 0.3950, 0.0)
LEVEL = (0.0, -0.7329, 0.8326, 0.0, -0.0997, 0.0)
MOUTH_AHEAD = (0.0, -0.2496, 0.5280, 0.0, -0.2785, 0.0)
MOUTH_ASIDE = (-0.2037, -0.3562, 0.5202, -0.9019, -0.2608, 0.8851)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("joint", ARM_JOINTS)
@pytest.mark.parametrize("arm", ARM_BASES)
def test_a_step_settles_within_2_percent_in_400_ms_and_overshoots_at_most_5(
    model: mujoco.MjModel, data: mujoco.MjData, arm: str, joint: str, direction: int
) -> None:
    step = 0.3 * direction
    moving = data.joint(f"{arm}/{joint}")
    start = moving.qpos[0]
    data.actuator(f"{arm}/{joint}").ctrl += step
    response = []
    for _ in range(round(1.5 / CONTROL_PERIOD)):
        mujoco.mj_step(model, data, SUBSTEPS)
        response.append((moving.qpos[0] - start) / step)
        others = [data.joint(f"{arm}/{j}").qpos[0] for j in ARM_JOINTS if j != joint]
        held = [q for j, q in zip(ARM_JOINTS, HOME_QPOS, strict=True) if j != joint]
        # "The other joints hold": a step of one servo shakes its neighbours by a degree or so.
        np.testing.assert_allclose(others, held, atol=0.03)
    settled = response[round(0.4 / CONTROL_PERIOD) - 1 :]
    np.testing.assert_allclose(settled, 1.0, atol=0.02)
    assert max(response) <= 1.05


@pytest.mark.parametrize("arm", ARM_BASES)
def test_arms_hold_their_pose_against_gravity(
    model: mujoco.MjModel, data: mujoco.MjData, arm: str
) -> None:
    mujoco.mj_step(model, data, 500)
    angles = [data.joint(f"{arm}/{joint}").qpos[0] for joint in ARM_JOINTS]
    np.testing.assert_allclose(angles, HOME_QPOS, atol=1e-3)


def test_servo_forces_stay_within_the_published_efforts(model: mujoco.MjModel) -> None:
    efforts = dict(zip(ARM_JOINTS, (10, 20, 15, 2, 5, 1), strict=True))  # N m, the URDF's
    for arm in ARM_BASES:
        for joint, effort in efforts.items():
            assert tuple(model.actuator(f"{arm}/{joint}").forcerange) == (-effort, effort)
        # 5 N a finger: the gripper's servo pulls on both.
        assert tuple(model.actuator(f"{arm}/gripper").forcerange) == (-10, 10)


class Feeder:
    """Moves the right arm through joint targets, as a policy does: a new target every 20 ms."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.model, self.data = model, data
        self.servos = [model.actuator(f"right/{joint}").id for joint in ARM_JOINTS]
        self.target = np.array(HOME_QPOS)
        self.cube_in_gripper: list[np.ndarray] = []

    def step(self) -> None:
        """One control period; notes where the cube is, (3,) m in the gripper's frame."""
        self.data.ctrl[self.servos] = self.target
        mujoco.mj_step(self.model, self.data, SUBSTEPS)
        site = self.data.site("right/gripper")
        offset = self.data.body("cube").xpos - site.xpos
        self.cube_in_gripper.append(site.xmat.reshape(3, 3).T @ offset)

    def move(self, goal: tuple[float, ...], speed: float = 1.0, hold: float = 0.1) -> None:
        """Go to joint angles; the fastest joint at ``speed`` rad/s; then hold, s."""
        start, end = self.target, np.array(goal)
        steps = max(1, int(np.abs(end - start).max() / speed / CONTROL_PERIOD))
        for i in range(1, steps + 1):
            self.target = start + (end - start) * i / steps
            self.step()
        self.wait(hold)

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / CONTROL_PERIOD)):
            self.step()

    def grip(self, target: float, seconds: float) -> np.ndarray:
        """Set the gripper's target; return the positions of both fingers after each step, m."""
        self.data.actuator("right/gripper").ctrl = target
        fingers = []
        for _ in range(round(seconds / CONTROL_PERIOD)):
            self.step()
            left, right = (self.data.joint(f"right/{side}_finger") for side in ("left", "right"))
            fingers.append([left.qpos[0], -right.qpos[0]])
        return np.array(fingers)


@pytest.fixture
def feeder(model: mujoco.MjModel, data: mujoco.MjData) -> Feeder:
    """The arm with its open fingers around the cube."""
    feeder = Feeder(model, data)
    feeder.move(ABOVE)
    feeder.move(AT_CUBE, speed=0.5, hold=0.3)
    return feeder


def test_fingers_close_on_the_cube_in_400_ms_and_open_again(feeder: Feeder) -> None:
    closing = feeder.grip(FINGER_CLOSED, 1.0)
    holding = FINGER_CLOSED + CUBE_SIZE / 2
    # Rubber gives by 0.1 mm, no more; both fingers press alike.
    np.testing.assert_allclose(closing[round(0.4 / CONTROL_PERIOD) - 1 :], holding, atol=2e-4)
    assert feeder.data.actuator("right/gripper").force[0] == pytest.approx(-10, abs=0.1)
    opening = feeder.grip(FINGER_OPEN, 0.4)
    np.testing.assert_allclose(opening[-1], FINGER_OPEN, atol=1e-3)
    np.testing.assert_allclose(opening[:, 0], opening[:, 1], atol=1e-3)


def test_empty_fingers_close_without_overshoot(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    feeder = Feeder(model, data)
    for target in (FINGER_CLOSED, FINGER_OPEN):
        fingers = feeder.grip(target, 0.4)
        np.testing.assert_allclose(fingers[-1], target, atol=1e-3)
        # The joint's stops are soft: half a millimetre of travel.
        assert np.all((fingers > FINGER_CLOSED - 5e-4) & (fingers < FINGER_OPEN + 5e-4))


def test_a_held_cube_slips_less_than_2_mm_in_a_12_s_episode(feeder: Feeder) -> None:
    feeder.grip(FINGER_CLOSED, 0.5)
    start = len(feeder.cube_in_gripper)
    feeder.move(LIFTED)
    feeder.move(LEVEL)
    for _ in range(2):  # an approach and a retreat more than an episode has
        for goal in (MOUTH_AHEAD, MOUTH_ASIDE, LEVEL):
            feeder.move(goal)
    feeder.wait(12.0 - (len(feeder.cube_in_gripper) - start) * CONTROL_PERIOD)
    path = np.array(feeder.cube_in_gripper[start - 1 :])
    assert len(path) == 601
    assert np.linalg.norm(path - path[0], axis=1).max() < 0.002
    # No jitter: between control steps the cube never jumps.
    assert max(np.linalg.norm(b - a) for a, b in pairwise(path)) < 2e-4
    assert not np.any(feeder.data.warning.number)


def test_a_released_cube_falls(feeder: Feeder) -> None:
    feeder.grip(FINGER_CLOSED, 0.5)
    feeder.move(LIFTED)
    height = feeder.data.body("cube").xpos[2]
    assert height > 0.25
    feeder.grip(FINGER_OPEN, 0.5)
    assert feeder.data.body("cube").xpos[2] < height - 0.2


def test_the_cube_lies_still_on_the_table(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    before = data.body("cube").xpos.copy()
    mujoco.mj_step(model, data, 1500)
    np.testing.assert_allclose(data.body("cube").xpos, before, atol=1e-5)
    assert before[2] == pytest.approx(CUBE_SIZE / 2, abs=3e-4)


def body_pairs(model: mujoco.MjModel, data: mujoco.MjData) -> set[tuple[str, str]]:
    """Bodies in contact."""
    pairs = model.geom_bodyid[data.contact.geom[: data.ncon]]
    return {(model.body(a).name, model.body(b).name) for a, b in pairs}


def test_at_home_nothing_touches_but_the_cube_the_table(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    assert body_pairs(model, data) == {("world", "cube")}


def test_neighbouring_links_never_touch_and_a_folded_arm_does(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    neighbours = [
        ("base_link", "shoulder_link"),
        ("shoulder_link", "upper_arm_link"),
        ("upper_arm_link", "upper_forearm_link"),
        ("upper_forearm_link", "lower_forearm_link"),
        ("lower_forearm_link", "wrist_link"),
        ("wrist_link", "gripper_link"),
        ("lower_forearm_link", "gripper_link"),
        ("left_finger_link", "right_finger_link"),
        ("gripper_bar_link", "left_finger_link"),
        ("wrist_link", "left_finger_link"),
    ]
    never = {(f"right/{a}", f"right/{b}") for a, b in neighbours}
    never |= {(b, a) for a, b in never}
    rng = np.random.default_rng(4)
    seen: set[tuple[str, str]] = set()
    limits = np.array([model.joint(f"right/{joint}").range for joint in ARM_JOINTS])
    address = [model.joint(f"right/{joint}").qposadr[0] for joint in ARM_JOINTS]
    for angles in rng.uniform(*limits.T, (400, 6)):
        data.qpos[address] = angles
        finger = rng.choice([FINGER_CLOSED - 1e-4, FINGER_OPEN])  # pressed shut, or open
        data.joint("right/left_finger").qpos = finger
        data.joint("right/right_finger").qpos = -finger
        mujoco.mj_forward(model, data)
        seen |= body_pairs(model, data)
    assert not seen & never
    assert ("right/base_link", "right/gripper_bar_link") in seen  # self-collision is on
    assert ("world", "right/gripper_bar_link") in seen  # and so is the table
