"""The face on its own, and the cell at rest, for every test that looks at them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, add_cube, build_cell
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.face import FaceModel, add_face
from robo_manip_baselines.observation.spec import ARM_JOINTS


@dataclass(frozen=True)
class Bust:
    """The face alone, and a cube and a probe (a robot's contact bits) that float."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def place(self, mouth: np.ndarray, turn: np.ndarray, jaw: float) -> None:
        """Put mouth (3,) m, head (4,) wxyz as recorded, and jaw (m) where they are asked for."""
        for name, (at, quat) in FaceModel.load().body_poses(mouth, turn, jaw).items():
            body = self.model.body(name).mocapid[0]
            self.data.mocap_pos[body], self.data.mocap_quat[body] = at, quat
            if name == "face/mouth":
                self.data.joint("face/cavity").qpos[:] = [*at, *quat]
        mujoco.mj_forward(self.model, self.data)

    def skin_vertices(self) -> np.ndarray:
        """World positions (V, 3) of the measured face, skinned by MuJoCo."""
        scene = mujoco.MjvScene(self.model, 300)
        mujoco.mjv_updateScene(
            self.model, self.data, mujoco.MjvOption(), None, mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL.value, scene,
        )  # fmt: skip
        skin = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SKIN, "face/skin")
        start = self.model.skin_vertadr[skin]
        return np.array(scene.skinvert).reshape(-1, 3)[start : start + 468].astype(float)


@pytest.fixture(scope="module")
def bust() -> Bust:
    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.002"/>
        <visual><headlight ambient=".4 .4 .4" diffuse=".5 .5 .5"/></visual>
        <worldbody><light pos="1 0.5 1"/>
        <body name="cube" pos="0 0 5"><freejoint/>
          <geom type="box" size=".02 .02 .02" mass=".04" conaffinity="5"/></body>
        <body name="probe" pos="0 1 5"><freejoint/>
          <geom name="probe" type="box" size=".03 .012 .008" mass=".1" conaffinity="3"/></body>
        </worldbody></mujoco>"""
    )
    add_face(spec)
    model = spec.compile()
    return Bust(model, mujoco.MjData(model))


@pytest.fixture(scope="module")
def face() -> FaceModel:
    return FaceModel.load()


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    spec = build_cell()
    add_cube(spec)
    return spec.compile()


@pytest.fixture
def data(model: mujoco.MjModel) -> mujoco.MjData:
    """Both arms at home, fingers open, the cube on the table, at rest."""
    data = mujoco.MjData(model)
    for arm in ARM_BASES:
        for joint, angle in zip(ARM_JOINTS, HOME_QPOS, strict=True):
            data.joint(f"{arm}/{joint}").qpos = angle
            data.actuator(f"{arm}/{joint}").ctrl = angle
        data.joint(f"{arm}/left_finger").qpos = FINGER_OPEN
        data.joint(f"{arm}/right_finger").qpos = -FINGER_OPEN
        data.actuator(f"{arm}/gripper").ctrl = FINGER_OPEN
    mujoco.mj_step(model, data, 200)  # 0.4 s
    return data
