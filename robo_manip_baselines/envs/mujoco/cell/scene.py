"""The cell: two VX300s arms at a table, three cameras, and the physics options, as a MuJoCo spec.

World frame: x right, y forward, z up; the table top is z = 0; metres, radians, seconds. Whoever
needs a head, a cube or anything else adds it to the spec before compiling.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.vx300s import arm_spec
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import pip_install

TIMESTEP: Final = 0.002
"""Physics step, seconds: ten make one control step at 50 Hz."""

CONTROL_PERIOD: Final = 0.02
"""s between two actions (paper, Algorithm 1, line 2)."""

BASE_X: Final = 0.469
BASE_Y: Final = 0.5
"""The arms' bases stand at (∓`BASE_X`, `BASE_Y`, 0), facing each other (public ALOHA cell)."""

ARM_BASES: Final = {
    "left": ((-BASE_X, BASE_Y, 0.0), (1.0, 0.0, 0.0, 0.0)),
    "right": ((BASE_X, BASE_Y, 0.0), (0.0, 0.0, 0.0, 1.0)),
}
"""Position (m) and orientation (wxyz) of each arm's base, world frame."""

MOUTH_BASE: Final = (0.0, BASE_Y, 0.35)
"""m, world: where the mouth of a head that looks along +x is before any random offset. A level
gripper of the right arm reaches every place around it that recorded motion leads to."""

CUBE_SIZE: Final = 0.04
"""Edge of the cube, metres."""

CUBE_MASS: Final = 0.04
"""Mass of the cube, kg: that of 64 cm³ of firm food (0.6 g/cm³)."""

FRONT_CLOSE_FOVY: Final = 47.0
"""Vertical field of view of ``front_close``, degrees (the paper's camera is 75° × 47°)."""

# Contact bits: 1 is the world of solid things, 2 the outside of a face (touches robots only),
# 4 the inside of a mouth (touches the cube only).
SOLID, FACE, MOUTH = 1, 2, 4

_TABLE_HALF: Final = (0.66, 0.40, 0.02)
_TABLE_HEIGHT: Final = 0.75


def require_mujoco(version: str = mujoco.__version__) -> None:
    """Refuse the MuJoCo releases that this cell does not behave in.

    Raises:
        RequestError: before 3.17, whose options differ, and in 4.0.0, whose sparse Cholesky
            factorisation gives wrong accelerations.
    """
    number = tuple(int(part) for part in version.split(".")[:2] if part.isdigit())
    if number < (3, 17) or version == "4.0.0":
        raise RequestError(
            f"MuJoCo {version} is not supported (valid: 3.17 or later, but not 4.0.0, whose "
            f"accelerations are wrong); run: {pip_install('mujoco>=3.17,!=4.0.0')}"
        )


def build_cell() -> mujoco.MjSpec:
    """Return the cell as an editable spec: table, arms ``left/`` and ``right/``, cameras, lights.

    Raises:
        RequestError: if the installed MuJoCo is one that the cell does not behave in.
    """
    require_mujoco()
    spec = mujoco.MjSpec()
    spec.modelname = "vx300s_cell"
    spec.compiler.degree = False
    _set_options(spec)
    _set_visual(spec)
    _add_room(spec)
    for arm in ARM_BASES:
        attach_arm(spec, arm)
    return spec


def attach_arm(spec: mujoco.MjSpec, arm: str) -> None:
    """Stand an arm of `ARM_BASES` on its base; its names get the prefix ``left/`` or ``right/``."""
    position, quat = ARM_BASES[arm]
    frame = spec.worldbody.add_frame(pos=position, quat=quat)
    spec.attach(arm_spec(), prefix=f"{arm}/", frame=frame)


def add_cube(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """Add the red cube, lying free on the table at (0.1, 0.5): body, free joint and geom ``cube``.

    Its contact bits let it touch robots, the table and the inside of a mouth, not the outside of
    a face.
    """
    half = CUBE_SIZE / 2
    body = spec.worldbody.add_body(name="cube", pos=(0.1, BASE_Y, half))
    body.add_freejoint(name="cube")
    body.add_geom(
        name="cube",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(half, half, half),
        mass=CUBE_MASS,
        rgba=(0.85, 0.10, 0.08, 1),
        contype=SOLID,
        conaffinity=SOLID | MOUTH,
        condim=4,
        friction=(0.8, 0.01, 0.0001),
    )
    return body


def look_at(position: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """Return the orientation of a camera at ``position`` that looks at ``target``, image up = z.

    Both are (3,) in metres, world frame. The result is a (4,) quaternion wxyz, world from camera
    (camera: x right, y up, looking along −z). Looking straight down, image up is world y.
    """
    back = np.asarray(position, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.column_stack([right, np.cross(back, right), back])
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    return quat


def _set_options(spec: mujoco.MjSpec) -> None:
    """Set every option that matters, so that no release's defaults decide for us.

    (The cell has no weld; whoever adds one should state its ``torquescale``, which releases have
    changed too.)
    """
    option = spec.option
    option.timestep = TIMESTEP
    option.gravity[:] = (0.0, 0.0, -9.81)
    # Implicit in the servos' velocity feedback: stable at 2 ms with stiff, well damped servos.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Elliptic cones with friction stiffer than the normal direction keep a held cube from creeping.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # Newton on dense matrices: some thirty degrees of freedom are too few for sparsity to pay.
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations, option.tolerance = 100, 1e-8
    option.ls_iterations, option.ls_tolerance = 50, 0.01
    option.noslip_iterations = 0
    option.ccd_iterations, option.ccd_tolerance = 35, 1e-6
    option.disableflags = option.enableflags = 0
    # Boxes, capsules and spheres have colliders of their own. The rest (cylinders, ellipsoids)
    # goes through the native convex collider, with one contact point a pair: releases have
    # changed both defaults.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    # Islands are solved one by one or all together with the same result; together is what every
    # supported release can do.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    # A diverged simulation is to be seen, not silently reset.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)


def _set_visual(spec: mujoco.MjSpec) -> None:
    """Keep drawing cheap: plain lights, coarse cylinders, buffers no larger than a video needs."""
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = 1280, 960
    quality = visual.quality
    quality.offsamples, quality.shadowsize = 0, 1024
    quality.numslices, quality.numstacks, quality.numquads = 16, 4, 1
    light = visual.headlight
    light.ambient[:], light.diffuse[:], light.specular[:] = (0.38,) * 3, (0.30,) * 3, (0.0,) * 3
    visual.map.znear, visual.map.zfar = 0.01, 8.0  # times the scene's extent
    spec.stat.center[:] = (0.0, BASE_Y, 0.2)
    spec.stat.extent = 1.0


def _add_room(spec: mujoco.MjSpec) -> None:
    """Add the table, the floor, the lights and the cameras."""
    world = spec.worldbody
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.add_material(name="table", rgba=(0.72, 0.62, 0.49, 1), specular=0.1, shininess=0.1)
    spec.add_material(name="table_frame", rgba=(0.33, 0.34, 0.36, 1), specular=0.2)
    spec.add_material(name="floor", rgba=(0.52, 0.55, 0.58, 1), specular=0.0)
    spec.add_material(name="wall", rgba=(0.80, 0.81, 0.80, 1), specular=0.0)
    width, depth, thickness = _TABLE_HALF
    world.add_geom(
        name="table",
        type=box,
        size=_TABLE_HALF,
        pos=(0, BASE_Y, -thickness),
        material="table",
        contype=SOLID,
        conaffinity=SOLID,
        friction=(0.8, 0.005, 0.0001),
    )
    untouchable: dict[str, Any] = {"contype": 0, "conaffinity": 0}
    leg = (_TABLE_HEIGHT - 2 * thickness) / 2
    for side, end in itertools.product((-1, 1), repeat=2):
        foot = (side * (width - 0.05), BASE_Y + end * (depth - 0.05), -2 * thickness - leg)
        size = (0.025, 0.025, leg)
        world.add_geom(type=box, size=size, pos=foot, material="table_frame", **untouchable)
    # A floor and three walls: all that is seen behind the table.
    for name, size, position in (
        ("floor", (3.0, 3.0, 0.01), (0, BASE_Y, -_TABLE_HEIGHT - 0.01)),
        ("wall_back", (3.0, 0.01, 3.0), (0, BASE_Y + 3.0, 3.0 - _TABLE_HEIGHT)),
        ("wall_left", (0.01, 3.0, 3.0), (-3.0, BASE_Y, 3.0 - _TABLE_HEIGHT)),
        ("wall_right", (0.01, 3.0, 3.0), (3.0, BASE_Y, 3.0 - _TABLE_HEIGHT)),
    ):
        material = name.partition("_")[0]
        world.add_geom(
            name=name, type=box, size=size, pos=position, material=material, **untouchable
        )
    # A key light from the front right, above, and a weak one opposite, to give shape to the side
    # that the key light leaves dark. A directional light's position is the centre of its shadows.
    lights = ((-0.35, 0.5, -0.8), 0.5, True), ((0.6, 0.3, -0.5), 0.2, False)
    for direction, diffuse, shadow in lights:
        world.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=(np.array([0, BASE_Y, 0.2]) - 2.0 * np.array(direction)).tolist(),
            dir=direction,
            diffuse=(diffuse, diffuse, diffuse),
            specular=(0.2, 0.2, 0.2) if shadow else (0, 0, 0),
            castshadow=shadow,
        )
    # front_close sees the mouth from 0.58 m, 32 degrees to the side and 12 below it, a compromise:
    # nearer to the arm's own line, or from its height, gripper and cube hide the mouth earlier;
    # further to the side, or from above, a detector loses heads that turn or nod.
    for name, position, target, fovy in (
        ("top", (0.08, BASE_Y, 1.15), (0.08, BASE_Y, 0.0), 48.0),
        ("angle", (0.60, -0.35, 0.72), (0.10, BASE_Y, 0.18), 45.0),
        ("front_close", (0.481, BASE_Y - 0.301, 0.229), MOUTH_BASE, FRONT_CLOSE_FOVY),
    ):
        quat = look_at(position, target).tolist()
        world.add_camera(name=name, pos=position, quat=quat, fovy=fovy)
