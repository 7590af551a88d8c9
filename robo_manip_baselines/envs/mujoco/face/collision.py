"""Collision geoms of the face, hidden: of the head that is drawn, and of the physical one.

Frames and bodies are those of `build`. Regions of the face are told apart in `contact`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import FACE, MOUTH
from robo_manip_baselines.envs.mujoco.face.model import (
    REST_OPENING,
    FaceModel,
    hinge_quaternion,
    multiply,
    rotate,
)

_BOX, _ELLIPSOID = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID

_STYLE: dict[str, Any] = {
    "mass": 0,
    "group": 3,
    "conaffinity": 0,
    "rgba": (0.9, 0.5, 0.2, 0.4),
    "priority": 2,  # or the stiff rubber of the finger pads would decide
}
_SLIPPERY, _STICKY = (0.3, 0.005, 0.0001), (1.0, 0.01, 0.0001)

# Flesh gives way: a finger of the arm sinks in by a millimetre for every newton or two.
_SOFT: dict[str, Any] = {**_STYLE, "solref": (0.05, 1.0), "solimp": (0.9, 0.9, 0.001, 0.5, 2.0)}
_OUTSIDE: dict[str, Any] = {**_SOFT, "contype": FACE, "friction": _SLIPPERY}
_INSIDE: dict[str, Any] = {**_SOFT, "contype": MOUTH, "friction": _STICKY}

_LIP_RADIUS: Final = 0.004
_UPPER_CHAIN: Final = (78, 80, 82, 312, 310, 308)
_LOWER_CHAIN: Final = (308, 318, 317, 87, 88, 78)
"""Landmarks of the inner lips that the capsules run between, corner to corner."""

_SKULL: Final = ("head", "skull", (0.100, 0.076, 0.092), (-0.055, 0.0, 0.030))
_NOSE: Final = ("head", "nose", (0.020, 0.013, 0.026), (0.052, 0.0, -0.004))
_CHIN: Final = ("jaw", "chin", (0.022, 0.024, 0.012), (0.038, 0.0, -0.072))
_CHEEKS: Final = ("head", "cheeks", (0.060, 0.070, 0.036), (-0.015, 0.0, 0.000))
_ELLIPSOIDS: Final = (_SKULL, _CHEEKS, _NOSE, _CHIN)
"""Body, name, half axes, centre (head: body frame; jaw: from its own origin)."""

_PHYSICAL_ELLIPSOIDS: Final = (
    _SKULL,
    # The drawn skin lies 1 cm before the skull's ellipsoid at the forehead, and before that of the
    # cheeks beside the nose.
    ("head", "forehead", (0.070, 0.062, 0.032), (-0.020, 0.0, 0.064)),
    ("head", "cheek_skin_left", (0.034, 0.027, 0.028), (0.004, 0.045, -0.004)),
    ("head", "cheek_skin_right", (0.034, 0.027, 0.028), (0.004, -0.045, -0.004)),
    _NOSE,
    _CHIN,
)

_TONGUE: Final = "tongue_floor"
_MOUTH_BOXES: Final = (
    # name, half sizes, centre in the mouth frame, tilt about y (negative: falls to the back)
    (_TONGUE, (0.045, 0.035, 0.006), (-0.030, 0.0, -0.032), -0.07),
    ("cheek_left", (0.036, 0.006, 0.036), (-0.042, 0.040, 0.0), 0.0),
    ("cheek_right", (0.036, 0.006, 0.036), (-0.042, -0.040, 0.0), 0.0),
    ("throat", (0.006, 0.040, 0.036), (-0.082, 0.0, 0.0), 0.0),
    ("palate", (0.036, 0.035, 0.006), (-0.042, 0.0, 0.040), 0.0),
)

Bodies = Mapping[str, mujoco.MjsBody]
"""``head``, ``jaw``, ``mouth`` and ``torso`` -> body."""


def add_collision(spec: mujoco.MjSpec, body: Bodies, model: FaceModel) -> None:
    """Add the collision geoms to the bodies ``head``, ``jaw`` and ``torso``, and a mouth's inside.

    The inside of the mouth is a body of its own that a stiff weld drags after ``face/mouth``.
    Bodies moved by mocap have no velocity in MuJoCo, so that friction on one would hold a cube
    fast in the world while the mouth moves away from under it.
    """
    _add_ellipsoids(body, _ELLIPSOIDS, dict.fromkeys((e[1] for e in _ELLIPSOIDS), _OUTSIDE))
    _add_neck_and_bust(body, _OUTSIDE)
    _add_lips(body, model, _OUTSIDE)
    cavity = _add_cavity(spec, body["mouth"])
    for name, size, centre, tilt in _MOUTH_BOXES:
        quat = (np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0)
        cavity.add_geom(name=f"face/{name}", type=_BOX, size=size, pos=centre, quat=quat, **_INSIDE)


def _add_ellipsoids(
    body: Bodies, ellipsoids: Sequence[tuple[Any, ...]], styles: Mapping[str, dict[str, Any]]
) -> None:
    for owner, name, size, centre in ellipsoids:
        shape = {"type": _ELLIPSOID, "size": size, "pos": centre, **styles[name]}
        body[owner].add_geom(name=f"face/{name}", **shape)


def _add_cavity(spec: mujoco.MjSpec, mouth: mujoco.MjsBody) -> mujoco.MjsBody:
    """The body ``face/cavity``, welded to the mocap body ``mouth``."""
    cavity = spec.worldbody.add_body(
        name="face/cavity",
        pos=mouth.pos.tolist(),
        quat=mouth.quat.tolist(),
        gravcomp=1.0,
        mass=0.5,  # kg and kg m²: ten times the cube's, so that the cube does not move the mouth
        inertia=(5e-4,) * 3,
        explicitinertial=True,
    )
    cavity.add_freejoint(name="face/cavity")
    weld = spec.add_equality(
        name="face/cavity",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=mouth.name,
        name2=cavity.name,
        solref=(
            0.004,
            1.0,
        ),  # time constant, s: twice the physics step, the stiffest that is stable
    )
    # anchor, relative position and orientation, torque scale (explicit: its default has changed)
    weld.data[:11] = (0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1)
    return cavity


def _add_neck_and_bust(body: Bodies, style: dict[str, Any]) -> None:
    neck = (-0.055, 0, -0.03, -0.060, 0, -0.12)
    _add_capsule(body["head"], "neck", 0.052, neck, style)
    shoulders = (-0.134, -0.125, -0.240, -0.134, 0.125, -0.240)
    _add_capsule(body["torso"], "shoulders", 0.085, shoulders, _OUTSIDE)
    size, centre = (0.095, 0.195, 0.11), (-0.136, 0, -0.34)
    body["torso"].add_geom(name="face/chest", type=_BOX, size=size, pos=centre, **_OUTSIDE)


def _add_capsule(
    body: mujoco.MjsBody, name: str, radius: float, ends: Sequence[float], style: dict[str, Any]
) -> None:
    kind, size = mujoco.mjtGeom.mjGEOM_CAPSULE, (radius, 0, 0)
    body.add_geom(name=f"face/{name}", type=kind, size=size, fromto=ends, **style)


def _add_lips(body: Bodies, model: FaceModel, style: dict[str, Any]) -> None:
    """Ten capsules inside the lips, upper ones on the head, lower ones on the jaw.

    They lie where the lips are at `REST_OPENING`, midway between inner and outer edge, so that
    they leave the opening itself free.
    """
    angle = model.jaw_angle(REST_OPENING)
    at = model.deform(angle)
    back = hinge_quaternion(angle) * [1, -1, -1, -1]
    rings = model.rings
    outer = dict(zip(rings["lips_inner"].tolist(), rings["lips_outer"].tolist(), strict=True))
    count = 0
    for owner, chain in (("head", _UPPER_CHAIN), ("jaw", _LOWER_CHAIN)):
        inner = np.array(chain)
        line = 0.5 * (at[inner] + at[[outer[i] for i in chain]]) - [_LIP_RADIUS, 0.0, 0.0]
        if owner == "jaw":
            line = rotate(back, line - model.hinge)
        for start, end in pairwise(line.tolist()):
            _add_capsule(body[owner], f"lip_{count}", _LIP_RADIUS, [*start, *end], style)
            count += 1


# -- the physical face ----------------------------------------------------------------------------

FINGER_RADIUS: Final = 0.005
"""m, of the round punch with the area of a finger pad's end, 4 x 20 mm."""

_LAYER: Final = ((0.0, 1.0), (0.2, 1.281), (0.4, 1.683), (0.6, 2.211), (0.8, 2.855), (1.0, 3.609))
"""Radius of a flat punch over the thickness of an incompressible layer on bone -> factor by which
the layer is stiffer than deep tissue (Hayes et al. 1972, J Biomech 5:541; quoted from memory)."""


def punch_stiffness(modulus: float, thickness: float) -> float:
    """Return N/m of soft tissue on bone under the end of a finger: 2 E a k / (1 - v²), v = 1/2.

    Args:
        modulus: Pa, Young's, of the tissue.
        thickness: m, down to the bone.
    """
    ratio, factor = np.transpose(_LAYER)
    layer = float(np.interp(FINGER_RADIUS / thickness, ratio, factor))
    return 2.0 * modulus * FINGER_RADIUS * layer / 0.75


_SKIN: Final = 36e3
"""Pa. Luboz, Promayon, Payan 2014: cheek, cheekbone, forehead and lower lip of 16 people have
moduli of 31 to 42 kPa (initial, by aspiration); the middle for all of them."""

TISSUE: Final[Mapping[str, float]] = {
    "skull": punch_stiffness(_SKIN, 0.005),
    "forehead": punch_stiffness(_SKIN, 0.005),
    "cheek_skin_left": punch_stiffness(_SKIN, 0.020),
    "cheek_skin_right": punch_stiffness(_SKIN, 0.020),
    "nose": punch_stiffness(_SKIN, 0.008),
    "lips": punch_stiffness(_SKIN, 0.012),
    "chin": punch_stiffness(_SKIN, 0.011),
    "neck": punch_stiffness(_SKIN, 0.020),
    "eye": punch_stiffness(_SKIN, 0.024),
    "tongue": punch_stiffness(15e3, 0.020),
    "mouth": punch_stiffness(15e3, 0.010),
    "teeth": 20e3,
}
"""N/m under the end of a finger. Thicknesses of soft tissue on bone, the moduli of eye, tongue and
inside, and the stiffness of teeth (the stiffest that 2 ms steps bear) are assumptions."""

FINGER_COMPLIANCE: Final = 3.53 + 0.40
"""1/kg, inverse masses of a finger link of the arm (MuJoCo's ``body_invweight0``) and of the head.
MuJoCo states the stiffness of contacts by the masses that meet; this makes it N/m for a finger."""

_IMPEDANCE: Final = 0.9


def tissue_contact(stiffness: float) -> dict[str, Any]:
    """Return MuJoCo's contact parameters of tissue of so many N/m, critically damped.

    At rest, the solver's force is k r d / ((1 - d) A) at depth r, with impedance d and inverse
    masses A, where ``solref`` = (-k d, -b d). Critical damping is an assumption: tissue does not
    bounce.
    """
    k = stiffness * FINGER_COMPLIANCE * (1.0 - _IMPEDANCE) / _IMPEDANCE
    return {
        "solref": (-k * _IMPEDANCE, -2.0 * math.sqrt(k) * _IMPEDANCE),
        "solimp": (_IMPEDANCE, _IMPEDANCE, 0.001, 0.5, 2.0),
    }


Styles = Mapping[str, Mapping[str, Any]]
"""Part of the face -> parameters of its geoms."""


def drawn_parts() -> Styles:
    """Return contact parameters of eyes, teeth and tongue, which are drawn.

    Robots and their tools touch them; food does not.
    """
    return {
        part: {
            "contype": FACE,
            "friction": _SLIPPERY,
            "priority": 2,
            **tissue_contact(TISSUE[part]),
        }
        for part in ("eye", "teeth", "tongue")
    }


def add_physical_collision(body: Bodies, model: FaceModel) -> None:
    """Add the hidden geoms of the physical face to the bodies ``head``, ``jaw`` and ``torso``.

    Robots, tools and objects touch the skin, and objects the inside of the mouth, as far as their
    own contact bits say so. Lips give way to food too, with the force that they do it.
    """

    def style(tissue: str, contype: int, friction: tuple[float, ...]) -> dict[str, Any]:
        soft = tissue_contact(TISSUE[tissue])
        return {**_STYLE, "contype": contype, "friction": friction, **soft}

    names = [ellipsoid[1] for ellipsoid in _PHYSICAL_ELLIPSOIDS]
    skin = {name: style(name, FACE | MOUTH, _SLIPPERY) for name in names}
    _add_ellipsoids(body, _PHYSICAL_ELLIPSOIDS, skin)
    _add_neck_and_bust(body, style("neck", FACE, _SLIPPERY))
    _add_lips(body, model, style("lips", FACE | MOUTH, _SLIPPERY))
    # Where they are at `REST_OPENING`; the floor of the mouth then goes with the jaw.
    angle = model.jaw_angle(REST_OPENING)
    mouth, back = model.lip_centre(angle), hinge_quaternion(angle) * [1, -1, -1, -1]
    for name, size, centre, tilt in _MOUTH_BOXES:
        place, quat = mouth + centre, hinge_quaternion(np.asarray(tilt))
        owner, tissue = "head", "mouth"
        if name == _TONGUE:
            owner, tissue = "jaw", "tongue"
            place, quat = rotate(back, place - model.hinge), multiply(back, quat)
        # The skin beside the mouth is the other side of its walls.
        contype = FACE | MOUTH if name.startswith("cheek") else MOUTH
        shape = {"type": _BOX, "size": size, "pos": place.tolist(), "quat": quat.tolist()}
        body[owner].add_geom(name=f"face/{name}", **shape, **style(tissue, contype, _STICKY))
