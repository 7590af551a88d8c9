"""The physical face: a head that follows the recording, yields, and returns; its regions."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD, MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel, add_face
from robo_manip_baselines.envs.mujoco.face.collision import TISSUE, punch_stiffness
from robo_manip_baselines.envs.mujoco.face.contact import REGIONS, FaceTouch
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.face.motions import MOTIONS, parse_motion
from robo_manip_baselines.envs.mujoco.face.physical import (
    AXIAL_STIFFNESS,
    JAW_STIFFNESS,
    ROCKING_STIFFNESS,
    TURNING_STIFFNESS,
    CompliantHead,
)
from robo_manip_baselines.envs.mujoco.face.replay import FaceReplay

MOUTH = np.array(MOUTH_BASE)
PROBE = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"
gravity="0 0 -9.81"/><worldbody>
<body name="right/finger_probe" pos="1 0.5 0.35"><freejoint name="probe"/>
<geom name="probe" type="sphere" size="0.004" mass="0.2833" contype="1" conaffinity="3"/></body>
</worldbody></mujoco>"""
"""A sphere with a robot's contact bits and the inverse mass of a finger link, 3.53 1/kg."""


PRESS = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"
gravity="0 0 0"/><worldbody>
<body name="right/finger_probe" pos="0.2 0.5 {height}">
<joint name="probe" type="slide" axis="1 0 0"/>
<geom name="probe" type="sphere" size="0.004" mass="0.2833" contype="1" conaffinity="3"/></body>
</worldbody></mujoco>"""
"""Likewise, on a rail along x."""


@dataclass
class Head:
    """A face of one kind with a probe, and what drives it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    kind: str

    def start(self, motion: str = "still", seed: int = 0) -> None:
        segment = parse_motion(motion).draw(
            np.random.default_rng(seed), MotionLibrary.load(), seed=seed
        )
        self.face, self.row = FaceModel.load(), 0
        self.replay = FaceReplay.lay_out(segment, MOUTH, self.face, timestep=0.002, substeps=10)
        mujoco.mj_resetData(self.model, self.data)
        if self.kind == "physical":
            self.driver = CompliantHead(self.model, self.face)
            self.driver.reset(self.data, self.replay)
        else:
            for body, (at, turn) in self.replay.bodies.items():
                number = self.model.body(body).mocapid[0]
                self.data.mocap_pos[number], self.data.mocap_quat[number] = at[0], turn[0]
            self.data.joint("face/cavity").qpos = (*MOUTH, 1, 0, 0, 0)
        mujoco.mj_forward(self.model, self.data)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.002)):
            self.row += 1
            self.driver.drive(self.data, self.row)
            self.driver.place_mouth(self.data)
            mujoco.mj_step(self.model, self.data)
        self.driver.place_mouth(self.data)
        mujoco.mj_kinematics(self.model, self.data)

    def push(
        self, force: tuple[float, float, float], torque: tuple[float, ...] = (0, 0, 0)
    ) -> None:
        self.data.xfrc_applied[self.model.body("face/neck").id] = (*force, *torque)

    @property
    def place(self) -> np.ndarray:
        return self.data.body("face/neck").xpos.copy()


def make_head(kind: str, probe: str = PROBE) -> Head:
    spec = mujoco.MjSpec.from_string(probe)
    add_face(spec, kind)
    model = spec.compile()
    return Head(model, mujoco.MjData(model), kind)


@pytest.fixture(scope="module")
def heads() -> dict[str, Head]:
    return {kind: make_head(kind) for kind in ("visual", "physical")}


@pytest.fixture
def head(heads: dict[str, Head]) -> Head:
    heads["physical"].start()
    return heads["physical"]


@pytest.mark.parametrize("motion", [*MOTIONS, "recorded+tremor"])
def test_an_undisturbed_head_follows_every_motion(motion: str, head: Head) -> None:
    head.start(motion, seed=4)
    for step in range(1, 26):
        head.run(CONTROL_PERIOD)
        # Without contact the muscles' forces are exact; the rest is the integrator's rounding.
        site = head.data.site("mouth").xpos
        np.testing.assert_allclose(site, head.replay.mouth[step, 0], atol=1e-5)
        orientation = head.replay.bodies["face/head"][1][head.row]
        assert abs(head.driver.orientation(head.data) @ orientation) == pytest.approx(1.0, abs=1e-8)
    opening = head.face.jaw_at(head.driver.jaw_angle(head.data))
    assert opening == pytest.approx(head.replay.jaw[25], abs=1e-4)


@pytest.mark.parametrize(
    ("force", "stiffness"),
    [
        ((-3.0, 0.0, 0.0), ROCKING_STIFFNESS),  # a push on the forehead
        ((0.0, 3.0, 0.0), ROCKING_STIFFNESS),
        ((0.0, 0.0, 20.0), AXIAL_STIFFNESS),  # under the chin
    ],
)
def test_a_constant_force_moves_the_head_by_force_over_stiffness_and_it_returns(
    force: tuple[float, float, float], stiffness: float, head: Head
) -> None:
    before = head.place
    head.push(force)
    head.run(3.0)
    np.testing.assert_allclose(head.place - before, np.array(force) / stiffness, atol=1e-4)
    head.push((0.0, 0.0, 0.0))
    head.run(3.0)
    np.testing.assert_allclose(head.place, before, atol=1e-4)


def test_a_push_off_the_centre_turns_the_head(head: Head) -> None:
    head.push((0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.5))
    head.run(3.0)
    x, y, z, w = head.driver.orientation(head.data)[[1, 2, 3, 0]]
    assert 2.0 * np.arctan2(z, w) == pytest.approx(0.5 / TURNING_STIFFNESS, rel=0.01)
    np.testing.assert_allclose([x, y], 0.0, atol=1e-6)


def test_the_jaw_gives_way_and_closes_the_mouth(head: Head) -> None:
    dof = head.model.joint("face/jaw").dofadr[0]
    before = head.driver.jaw_angle(head.data)
    head.driver.drive(head.data, 0)
    for _ in range(500):
        head.driver.drive(head.data, 0)
        head.data.qfrc_applied[dof] -= 0.8
        mujoco.mj_step(head.model, head.data)
    moved = head.driver.jaw_angle(head.data) - before
    assert moved == pytest.approx(-0.8 / JAW_STIFFNESS, rel=0.02)


def test_a_blow_leaves_everything_finite(head: Head) -> None:
    before = head.place
    head.push((-400.0, 200.0, 300.0), torque=(8.0, -8.0, 5.0))
    head.run(0.1)
    head.push((0.0, 0.0, 0.0))
    head.run(4.0)
    assert np.isfinite(head.data.qpos).all()
    np.testing.assert_allclose(head.place, before, atol=1e-3)


def test_tissue_gives_way_by_force_over_stiffness() -> None:
    """A finger presses on the forehead: its depth is the force over the stiffness."""
    lips = FaceModel.load().lip_centre(FaceModel.load().jaw_angle(REST_OPENING))
    head = make_head("physical", PRESS.format(height=MOUTH[2] - lips[2] + 0.064))
    head.start()
    force, wrench = 2.0, np.zeros(6)
    head.data.joint("probe").qpos = -0.115
    head.data.xfrc_applied[head.model.body("right/finger_probe").id, 0] = -force
    head.push((force, 0.0, 0.0))  # somebody holds the head from behind
    head.run(2.0)
    (depth,) = -head.data.contact.dist
    mujoco.mj_contactForce(head.model, head.data, 0, wrench)
    assert wrench[0] == pytest.approx(force, rel=0.05)  # the head has turned a little
    assert wrench[0] / depth == pytest.approx(TISSUE["forehead"], rel=0.05)


def test_thin_tissue_on_bone_is_stiffer() -> None:
    deep = 2.0 * 36e3 * 0.005 / 0.75
    assert punch_stiffness(36e3, 1e3) == pytest.approx(deep, rel=1e-3)
    assert punch_stiffness(36e3, 0.005) == pytest.approx(3.609 * deep)
    assert TISSUE["forehead"] > TISSUE["lips"] > TISSUE["cheek_skin_left"] > TISSUE["tongue"]


PLACES = {
    "forehead": (0.036, 0.0, 0.072),
    "eyes": (0.038, 0.032, 0.027),
    "nose": (0.070, 0.0, -0.008),
    "cheeks": (0.030, 0.046, 0.0),
    "lips": (0.047, 0.0, -0.036),
    "head": (-0.070, 0.070, 0.050),
    "neck": (-0.008, 0.0, -0.105),
}
"""Points at which a probe of 4 mm touches a region, in the frame of the head."""

PARTS = {
    "chin": ("chin", (0.018, 0.0, -0.004)),
    "teeth": ("teeth_upper", (0.0, 0.0, -0.004)),
    "tongue": ("tongue", (0.010, 0.0, 0.005)),
}
"""Regions that are touched beside the centre of a geom."""


@pytest.mark.parametrize("region", [*PLACES, *PARTS])
@pytest.mark.parametrize("kind", ["visual", "physical"])
def test_a_touch_is_told_apart_by_region(kind: str, region: str, heads: dict[str, Head]) -> None:
    if kind == "visual" and region in ("teeth", "tongue"):
        pytest.skip("robots do not touch the inside of the visual mouth")
    head = heads[kind]
    head.start()
    body, start = head.data.body("face/head"), head.model.joint("probe").qposadr[0]
    axes = body.xmat.reshape(3, 3)
    if region in PARTS:
        name, aside = PARTS[region]
        point = head.data.geom(f"face/{name}").xpos + axes @ aside
    else:
        point = body.xpos + axes @ PLACES[region]
    head.data.qpos[start : start + 3] = point
    mujoco.mj_forward(head.model, head.data)
    touch = FaceTouch(head.model, ())
    touch.read(head.model, head.data)
    found = {contact.region: contact for contact in touch.contacts}
    assert region in found
    assert found[region].toucher == "gripper"
    assert not found[region].is_food
    assert found[region].force > 0.0
    assert found[region].impulse == pytest.approx(0.002 * found[region].force)
    np.testing.assert_allclose(found[region].point, (point - body.xpos) @ axes, atol=0.02)
    row = touch.row()
    assert row["region_force"].shape == (len(REGIONS), len(touch.touchers))
    place = REGIONS.index(region), touch.touchers.index("gripper")
    assert row["region_force"][place] == pytest.approx(found[region].force)
    assert touch.robot_force > 0.0
    touch.clear()
    assert touch.contacts == ()
    assert not touch.row()["region_impulse"].any()
