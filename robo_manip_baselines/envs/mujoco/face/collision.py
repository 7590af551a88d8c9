"""What of the face can be touched: its outside by robots, the inside of its mouth by the cube.

Contact bits: the outside (`FACE`) meets robots only, never the cube, because soft lips give way to
food; the inside of the mouth (`MOUTH`) meets the cube only, and holds it once released.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final

import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.face.model import (
    REST_OPENING,
    FaceModel,
    hinge_quaternion,
    rotate,
)
from robo_manip_baselines.envs.mujoco.scene import FACE, MOUTH

_HIDDEN: Final[dict[str, Any]] = {
    "mass": 0,
    "group": 3,
    "conaffinity": 0,
    "rgba": (0.9, 0.5, 0.2, 0.4),
}
_SOFT: Final[dict[str, Any]] = {
    # Flesh gives way: a finger of the arm sinks in by a millimetre for every newton or two. The
    # geoms have priority, or the stiff rubber of the finger pads would decide.
    "priority": 2,
    "solref": (0.05, 1.0),
    "solimp": (0.9, 0.9, 0.001, 0.5, 2.0),
}
_OUTSIDE: Final[dict[str, Any]] = {
    **_HIDDEN,
    **_SOFT,
    "contype": FACE,
    "friction": (0.3, 0.005, 0.0001),
}
_INSIDE: Final[dict[str, Any]] = {
    **_HIDDEN,
    **_SOFT,
    "contype": MOUTH,
    "friction": (1.0, 0.01, 0.0001),
}

_CAVITY_MASS: Final = 0.5
_CAVITY_INERTIA: Final = 5e-4
"""kg and kg m²: ten times the cube's, so that the cube does not move the mouth."""
_CAVITY_LAG: Final = 0.004
"""Time constant of the weld, s: twice the physics step, the stiffest that is stable."""

_LIP_RADIUS: Final = 0.004
_UPPER_CHAIN: Final = (78, 80, 82, 312, 310, 308)
_LOWER_CHAIN: Final = (308, 318, 317, 87, 88, 78)
"""Landmarks of the inner lips that the capsules run between, corner to corner."""

_ELLIPSOIDS: Final = (
    # body, name, half axes, centre (head: body frame; jaw and torso: from their own origin)
    ("head", "skull", (0.100, 0.076, 0.092), (-0.055, 0.0, 0.030)),
    ("head", "cheeks", (0.060, 0.070, 0.036), (-0.015, 0.0, 0.000)),
    ("head", "nose", (0.020, 0.013, 0.026), (0.052, 0.0, -0.004)),
    ("jaw", "chin", (0.022, 0.024, 0.012), (0.038, 0.0, -0.072)),
)

_MOUTH_BOXES: Final = (
    # name, half sizes, centre in the mouth frame, tilt about y (negative: falls to the back)
    ("tongue_floor", (0.045, 0.035, 0.006), (-0.030, 0.0, -0.032), -0.07),
    ("cheek_left", (0.036, 0.006, 0.036), (-0.042, 0.040, 0.0), 0.0),
    ("cheek_right", (0.036, 0.006, 0.036), (-0.042, -0.040, 0.0), 0.0),
    ("throat", (0.006, 0.040, 0.036), (-0.082, 0.0, 0.0), 0.0),
    ("palate", (0.036, 0.035, 0.006), (-0.042, 0.0, 0.040), 0.0),
)


def add_collision(
    spec: mujoco.MjSpec, body: Mapping[str, mujoco.MjsBody], model: FaceModel
) -> None:
    """Add the collision geoms to the bodies ``head``, ``jaw`` and ``torso``, and a mouth's inside.

    The inside of the mouth is a body of its own that a stiff weld drags after ``face/mouth``.
    Bodies moved by mocap have no velocity in MuJoCo, so that friction on one would hold a cube
    fast in the world while the mouth moves away from under it.
    """
    for owner, name, size, centre in _ELLIPSOIDS:
        body[owner].add_geom(
            name=f"face/{name}",
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=size,
            pos=centre,
            **_OUTSIDE,
        )
    _add_neck_and_bust(body)
    _add_lips(body, model)
    cavity = _add_cavity(spec, body["mouth"])
    for name, size, centre, tilt in _MOUTH_BOXES:
        cavity.add_geom(
            name=f"face/{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=centre,
            quat=(np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0),
            **_INSIDE,
        )


def _add_cavity(spec: mujoco.MjSpec, mouth: mujoco.MjsBody) -> mujoco.MjsBody:
    """The body ``face/cavity``, welded to the mocap body ``mouth``."""
    cavity = spec.worldbody.add_body(
        name="face/cavity",
        pos=mouth.pos.tolist(),
        quat=mouth.quat.tolist(),
        gravcomp=1.0,
        mass=_CAVITY_MASS,
        inertia=(_CAVITY_INERTIA,) * 3,
        explicitinertial=True,
    )
    cavity.add_freejoint(name="face/cavity")
    weld = spec.add_equality(
        name="face/cavity",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=mouth.name,
        name2=cavity.name,
        solref=(_CAVITY_LAG, 1.0),
    )
    # anchor, relative position and orientation, torque scale (explicit: its default has changed)
    weld.data[:11] = (0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1)
    return cavity


def _add_neck_and_bust(body: Mapping[str, mujoco.MjsBody]) -> None:
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    body["head"].add_geom(
        name="face/neck",
        type=capsule,
        size=(0.052, 0, 0),
        fromto=(-0.055, 0, -0.03, -0.060, 0, -0.12),
        **_OUTSIDE,
    )
    body["torso"].add_geom(
        name="face/shoulders",
        type=capsule,
        size=(0.085, 0, 0),
        fromto=(-0.134, -0.125, -0.240, -0.134, 0.125, -0.240),
        **_OUTSIDE,
    )
    body["torso"].add_geom(
        name="face/chest",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(0.095, 0.195, 0.11),
        pos=(-0.136, 0, -0.34),
        **_OUTSIDE,
    )


def _add_lips(body: Mapping[str, mujoco.MjsBody], model: FaceModel) -> None:
    """Ten capsules inside the lips, upper ones on the head, lower ones on the jaw.

    They lie where the lips are at `REST_OPENING`, midway between inner and outer edge, so that
    they leave the opening itself free.
    """
    angle = model.jaw_angle(REST_OPENING)
    at = model.deform(angle)
    back = hinge_quaternion(angle) * [1, -1, -1, -1]
    outer = dict(
        zip(model.rings["lips_inner"].tolist(), model.rings["lips_outer"].tolist(), strict=True)
    )
    count = 0
    for owner, chain in (("head", _UPPER_CHAIN), ("jaw", _LOWER_CHAIN)):
        inner = np.array(chain)
        line = 0.5 * (at[inner] + at[[outer[i] for i in chain]]) - [_LIP_RADIUS, 0.0, 0.0]
        if owner == "jaw":
            line = rotate(back, line - model.hinge)
        for start, end in pairwise(line):
            body[owner].add_geom(
                name=f"face/lip_{count}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=(_LIP_RADIUS, 0, 0),
                fromto=[*start.tolist(), *end.tolist()],
                **_OUTSIDE,
            )
            count += 1
