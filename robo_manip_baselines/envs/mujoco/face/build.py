"""Put the face into a MuJoCo cell: bodies, skins, collision geoms and the site ``mouth``.

The shape and its kinematics are in `model`, the surfaces around the measured one in `mesh`, the
colours in `texture`, what can be touched in `collision`.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final

import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import FACE, MOUTH, MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import mesh
from robo_manip_baselines.envs.mujoco.face.mesh import (
    HAIR,
    SKIN,
    Floats,
    Surface,
    encode_png,
    paint,
    texture_coordinates,
)
from robo_manip_baselines.envs.mujoco.face.model import (
    REST_OPENING,
    FaceModel,
    hinge_quaternion,
    rotate,
)

BODIES: Final = ("face/head", "face/jaw", "face/mouth", "face/torso")
"""Mocap bodies, children of the world: the keys of `FaceModel.body_poses`."""

_TEXTURE_FILE: Final = "face_texture.png"

_EYE_RADIUS: Final = 0.0122
_IRIS_RADIUS: Final = 0.0064
_PUPIL_RADIUS: Final = 0.0034
_EAR_ANGLE: Final = 0.35
"""Ears stand off the head by this much, radians."""
_SHIRT: Final = (0.23, 0.42, 0.60, 1.0)
_LINING: Final = (0.14, 0.035, 0.04, 1.0)
_TONGUE: Final = (0.46, 0.19, 0.20, 1.0)
_TEETH: Final = (0.88, 0.85, 0.78, 1.0)
_SCLERA: Final = (0.96, 0.95, 0.94, 1.0)
_IRIS: Final = (0.30, 0.19, 0.11, 1.0)
_PUPIL: Final = (0.03, 0.02, 0.02, 1.0)

_VISUAL: Final[dict[str, Any]] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}


def add_face(spec: mujoco.MjSpec) -> None:
    """Add the face to ``spec``, at its nominal place, waiting to be fed.

    Bodies `BODIES` (mocap), site ``mouth`` on ``face/mouth`` (x axis: out of the face), skins and
    geoms named ``face/...``. Move it with `FaceModel.body_poses`.
    """
    model = FaceModel.load()
    rest = model.body_poses(MOUTH_BASE, (1, 0, 0, 0), REST_OPENING)
    body = {
        name.removeprefix("face/"): spec.worldbody.add_body(
            name=name, mocap=True, pos=at.tolist(), quat=turn.tolist()
        )
        for name, (at, turn) in rest.items()
    }
    body["mouth"].add_site(name="mouth", size=(0.002, 0.002, 0.002), rgba=(0, 0, 0, 0), group=4)
    _add_materials(spec)
    _add_skins(spec, model)
    _add_eyes(body["head"], model)
    _add_ears(body["head"])
    _add_mouth_parts(spec, body["head"], body["jaw"], model)
    _add_mesh(spec, body["head"], "hair", mesh.hair(model), _colour(HAIR))
    _add_mesh(spec, body["torso"], "shirt", mesh.bust(), _SHIRT)
    add_collision(spec, body, model)


def _colour(rgb: tuple[int, int, int]) -> tuple[float, float, float, float]:
    return (rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, 1.0)


def _add_materials(spec: mujoco.MjSpec) -> None:
    # Given as an in-memory file, not as a buffer, so that the cell can still be saved as XML.
    spec.assets = {**spec.assets, _TEXTURE_FILE: encode_png(paint())}
    spec.add_texture(name="face", type=mujoco.mjtTexture.mjTEXTURE_2D, file=_TEXTURE_FILE)
    skin = spec.add_material(name="face/skin", specular=0.15, shininess=0.2)
    skin.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "face"
    spec.add_material(name="face/lining", rgba=_LINING, specular=0.1, shininess=0.3)


def _add_skins(spec: mujoco.MjSpec, model: FaceModel) -> None:
    jaw = ("face/jaw", model.hinge)
    _add_skin(spec, "face/skin", mesh.head(model), jaw, "face/skin")
    _add_skin(spec, "face/lining", mesh.mouth_lining(model), jaw, "face/lining")
    mouth = model.lip_centre(model.jaw_angle(REST_OPENING))
    collar = mouth + np.array([-0.125, 0.0, -0.135])
    tube = mesh.neck(np.array([-0.068, 0.0, -0.040]), collar)
    _add_skin(spec, "face/neck", tube, ("face/torso", mouth), "face/skin")


def _add_skin(
    spec: mujoco.MjSpec, name: str, surface: Surface, second: tuple[str, Floats], material: str
) -> None:
    """Add ``surface`` (head frame), bound to the head and to a second body placed at a point."""
    everything = list(range(len(surface.vertices)))
    spec.add_skin(
        name=name,
        material=material,
        vert=surface.vertices.ravel().tolist(),
        texcoord=texture_coordinates(surface.vertices).ravel().tolist(),
        face=surface.triangles.ravel().tolist(),
        bodyname=["face/head", second[0]],
        bindpos=[0.0, 0.0, 0.0, *second[1].tolist()],
        bindquat=[1, 0, 0, 0, 1, 0, 0, 0],
        vertid=[everything, everything],
        vertweight=[(1 - surface.weight).tolist(), surface.weight.tolist()],
        group=1,
    )


def _add_mesh(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, surface: Surface, rgba: tuple[float, ...]
) -> None:
    spec.add_mesh(
        name=f"face/{name}",
        uservert=surface.vertices.ravel().tolist(),
        userface=surface.triangles.ravel().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    kind = mujoco.mjtGeom.mjGEOM_MESH
    body.add_geom(name=f"face/{name}", type=kind, meshname=f"face/{name}", rgba=rgba, **_VISUAL)


def _add_eyes(head: mujoco.MjsBody, model: FaceModel) -> None:
    for side in ("left", "right"):
        lids = model.vertices[model.rings[f"eye_{side}"]]
        centre = lids.mean(axis=0) - [_EYE_RADIUS - 0.0022, 0.0, 0.0]
        for part, radius, forward, rgba in (
            ("eye", _EYE_RADIUS, 0.0, _SCLERA),
            ("iris", _IRIS_RADIUS, _EYE_RADIUS - 0.0052, _IRIS),
            ("pupil", _PUPIL_RADIUS, _EYE_RADIUS - 0.0020, _PUPIL),
        ):
            head.add_geom(
                name=f"face/{part}_{side}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(radius, 0, 0),
                pos=centre + np.array([forward, 0.0, 0.0]),
                rgba=rgba,
                **_VISUAL,
            )


def _add_ears(head: mujoco.MjsBody) -> None:
    kind = mujoco.mjtGeom.mjGEOM_ELLIPSOID
    for name, side in (("left", 1), ("right", -1)):
        half_turn = side * _EAR_ANGLE / 2
        head.add_geom(
            name=f"face/ear_{name}",
            type=kind,
            size=(0.017, 0.006, 0.031),
            pos=(-0.034, side * 0.080, 0.006),
            quat=(np.cos(half_turn), 0.0, 0.0, np.sin(half_turn)),
            rgba=_colour(SKIN),
            **_VISUAL,
        )


def _add_mouth_parts(
    spec: mujoco.MjSpec, head: mujoco.MjsBody, jaw: mujoco.MjsBody, model: FaceModel
) -> None:
    lips = model.vertices[model.rings["lips_inner"]].mean(axis=0)
    upper = mesh.teeth(lips + np.array([-0.004, 0.0, 0.008]), -0.009)
    # the lower arch is smaller and bites behind the upper one
    foot = lips + np.array([-0.006, 0.0, -0.011]) - model.hinge
    lower = mesh.teeth(foot, 0.008, 0.019, 0.024)
    _add_mesh(spec, head, "teeth_upper", upper, _TEETH)
    _add_mesh(spec, jaw, "teeth_lower", lower, _TEETH)
    jaw.add_geom(
        name="face/tongue",
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=(0.026, 0.017, 0.007),
        pos=lips + np.array([-0.038, 0.0, -0.009]) - model.hinge,
        rgba=_TONGUE,
        **_VISUAL,
    )


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
