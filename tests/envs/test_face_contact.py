"""Contacts of the face, and support of a released cube."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import BODIES, REST_OPENING, FaceModel
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary

MOUTH = np.array(MOUTH_BASE)
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def test_contact_bits(bust) -> None:
    model = bust.model
    cavity = {"tongue_floor", "cheek_left", "cheek_right", "throat", "palate"}
    outside = {"skull", "cheeks", "nose", "chin", "neck", "shoulders", "chest"}
    outside |= {f"lip_{i}" for i in range(10)}
    for index in range(model.ngeom):
        geom = model.geom(index)
        if not geom.name.startswith("face/"):
            continue
        name = geom.name.removeprefix("face/")
        bits = 4 if name in cavity else 2 if name in outside else 0
        assert (geom.contype[0], geom.conaffinity[0]) == (bits, 0), name
        if bits:
            assert geom.group[0] == 3, name  # not drawn
    owner = {i: model.body(model.geom(f"face/lip_{i}").bodyid[0]).name for i in range(10)}
    assert [owner[i] for i in range(10)] == ["face/head"] * 5 + ["face/jaw"] * 5
    assert model.geom("face/tongue_floor").bodyid[0] == model.body("face/cavity").id


@pytest.mark.parametrize(
    ("offset", "touches"),
    [
        ((0.010, 0.0, 0.0), False),  # well aimed, the probe's front 2 cm behind the lips
        ((0.010, 0.003, 0.0), False),
        ((0.010, 0.0, 0.002), False),
        ((0.010, 0.0, 0.018), True),  # against the upper lip
        ((0.010, 0.0, -0.018), True),
        ((0.010, 0.028, 0.0), True),  # against a corner
        ((0.080, 0.0, 0.018), False),  # still ahead of the face
    ],
)
def test_lips_leave_the_opening_free(offset, touches: bool, bust) -> None:
    model, data = bust.model, bust.data
    mujoco.mj_resetData(model, data)
    data.body("probe").xpos[:] = 0
    adr = model.body("probe").jntadr[0]
    start = model.jnt_qposadr[adr]
    data.qpos[start : start + 3] = MOUTH + offset
    bust.place(MOUTH, UPRIGHT, REST_OPENING)
    names = {model.geom(geom).name for geom in np.unique(data.contact.geom)}
    touched = {name for name in names if name.startswith("face/")}
    assert bool(touched) == touches, touched


@pytest.mark.parametrize("depth", [0.010, 0.020, 0.030])
@pytest.mark.parametrize(
    ("side", "up", "euler"),
    [
        (0.0, 0.0, (0, 0, 0)),
        (0.01, 0.01, (10, -10, 5)),
        (-0.01, -0.01, (-20, 8, -8)),
        (0.0, 0.01, (0, 12, 0)),  # the head bows
    ],
)
def test_a_released_cube_stays_in_the_mouth(depth, side, up, euler, bust) -> None:
    model, data = bust.model, bust.data
    mujoco.mj_resetData(model, data)
    start = model.jnt_qposadr[model.body("cube").jntadr[0]]
    data.qpos[start : start + 3] = MOUTH + np.array([-depth, side, up])
    turn = Rotation.from_euler("YXZ", euler, degrees=True).as_quat()[[3, 0, 1, 2]]
    bust.place(MOUTH, turn, REST_OPENING)
    for _ in range(1000):  # two seconds
        mujoco.mj_step(model, data)
    site = data.site("mouth")
    out, across, above = (data.body("cube").xpos - site.xpos) @ site.xmat.reshape(3, 3)
    assert -0.06 < out < 0.0
    assert abs(across) < 0.02
    assert abs(above) < 0.02
    assert np.linalg.norm(data.body("cube").cvel) < 0.02


@pytest.mark.parametrize("clip", ["clm_cap12", "latentsync_demo2", "us_gov_whitehouse2021"])
def test_the_inside_of_the_mouth_goes_along_and_carries_the_cube(clip: str, bust) -> None:
    model, data = bust.model, bust.data
    rng = np.random.default_rng(5)
    segment = MotionLibrary.load().draw(rng, clips=[clip])
    times = np.arange(0.0, 4.0, model.opt.timestep)
    moved, turn, jaw = segment.at(times)
    poses = FaceModel.load().body_poses(MOUTH + moved, turn, jaw + REST_OPENING)
    mujoco.mj_resetData(model, data)
    start = model.jnt_qposadr[model.body("cube").jntadr[0]]
    bust.place(MOUTH + moved[0], turn[0], jaw[0] + REST_OPENING)
    site = data.site("mouth")
    data.qpos[start : start + 3] = site.xpos + site.xmat.reshape(3, 3) @ (-0.015, 0.0, 0.0)
    mocap = {name: model.body(name).mocapid[0] for name in BODIES}
    behind = []
    for step in range(len(times)):
        for name, body in mocap.items():
            data.mocap_pos[body] = poses[name][0][step]
            data.mocap_quat[body] = poses[name][1][step]
        mujoco.mj_step(model, data)
        lag = data.joint("face/cavity").qpos[:3] - poses["face/mouth"][0][step]
        behind.append(np.linalg.norm(lag))
    # the weld's time constant of 4 ms at the fastest recorded 0.3 m/s, twice over
    assert max(behind) < 0.003
    out, across, above = (data.body("cube").xpos - site.xpos) @ site.xmat.reshape(3, 3)
    assert -0.06 < out < 0.005
    assert abs(across) < 0.025
    assert abs(above) < 0.02
