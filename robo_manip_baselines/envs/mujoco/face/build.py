"""Put the face into a MuJoCo cell: bodies, skins, collision geoms and the site ``mouth``.

The shape and its kinematics are in `model`, the surfaces around the measured one in `mesh`, the
colours in `texture`, what can be touched in `collision`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

import cv2
import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import FACE, MOUTH, MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import mesh
from robo_manip_baselines.envs.mujoco.face.mesh import (
    HAIR,
    SKIN,
    Floats,
    Surface,
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

_BOX, _ELLIPSOID = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID

_EYE_RADIUS: Final = 0.0122
_TEETH: Final = (0.88, 0.85, 0.78, 1.0)

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
    _add_mesh(spec, body["torso"], "shirt", mesh.bust(), (0.23, 0.42, 0.60, 1.0))
    add_collision(spec, body, model)


def _colour(rgb: tuple[int, int, int]) -> tuple[float, float, float, float]:
    return (rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, 1.0)


def _add_materials(spec: mujoco.MjSpec) -> None:
    # Given as an in-memory file, not as a buffer, so that the cell can still be saved as XML.
    file = "face_texture.png"
    png = cv2.imencode(".png", cv2.cvtColor(paint(), cv2.COLOR_RGB2BGR))[1].tobytes()
    spec.assets = {**spec.assets, file: png}
    spec.add_texture(name="face", type=mujoco.mjtTexture.mjTEXTURE_2D, file=file)
    skin = spec.add_material(name="face/skin", specular=0.15, shininess=0.2)
    skin.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "face"
    dark_red = (0.14, 0.035, 0.04, 1.0)
    spec.add_material(name="face/lining", rgba=dark_red, specular=0.1, shininess=0.3)


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
            ("eye", _EYE_RADIUS, 0.0, (0.96, 0.95, 0.94, 1.0)),
            ("iris", 0.0064, _EYE_RADIUS - 0.0052, (0.30, 0.19, 0.11, 1.0)),
            ("pupil", 0.0034, _EYE_RADIUS - 0.0020, (0.03, 0.02, 0.02, 1.0)),
        ):
            name, place = f"face/{part}_{side}", centre + np.array([forward, 0.0, 0.0])
            head.add_geom(name=name, size=(radius, 0, 0), pos=place, rgba=rgba, **_VISUAL)


def _add_ears(head: mujoco.MjsBody) -> None:
    for name, side in (("left", 1), ("right", -1)):
        half_turn = side * 0.35 / 2  # ears stand off the head by 0.35 rad
        head.add_geom(
            name=f"face/ear_{name}",
            type=_ELLIPSOID,
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
    size, centre = (0.026, 0.017, 0.007), lips + np.array([-0.038, 0.0, -0.009]) - model.hinge
    red = (0.46, 0.19, 0.20, 1.0)
    jaw.add_geom(name="face/tongue", type=_ELLIPSOID, size=size, pos=centre, rgba=red, **_VISUAL)


# Flesh gives way: a finger of the arm sinks in by a millimetre for every newton or two. The geoms
# have priority, or the stiff rubber of the finger pads would decide.
_SOFT = {"priority": 2, "solref": (0.05, 1.0), "solimp": (0.9, 0.9, 0.001, 0.5, 2.0)}
_HIDDEN = {"mass": 0, "group": 3, "conaffinity": 0, "rgba": (0.9, 0.5, 0.2, 0.4), **_SOFT}
_OUTSIDE: dict[str, Any] = {**_HIDDEN, "contype": FACE, "friction": (0.3, 0.005, 0.0001)}
_INSIDE: dict[str, Any] = {**_HIDDEN, "contype": MOUTH, "friction": (1.0, 0.01, 0.0001)}

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
        shape = {"type": _ELLIPSOID, "size": size, "pos": centre, **_OUTSIDE}
        body[owner].add_geom(name=f"face/{name}", **shape)
    _add_neck_and_bust(body)
    _add_lips(body, model)
    cavity = _add_cavity(spec, body["mouth"])
    for name, size, centre, tilt in _MOUTH_BOXES:
        quat = (np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0)
        cavity.add_geom(name=f"face/{name}", type=_BOX, size=size, pos=centre, quat=quat, **_INSIDE)


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


def _add_neck_and_bust(body: Mapping[str, mujoco.MjsBody]) -> None:
    _add_capsule(body["head"], "neck", 0.052, (-0.055, 0, -0.03, -0.060, 0, -0.12))
    shoulders = (-0.134, -0.125, -0.240, -0.134, 0.125, -0.240)
    _add_capsule(body["torso"], "shoulders", 0.085, shoulders)
    size, centre = (0.095, 0.195, 0.11), (-0.136, 0, -0.34)
    body["torso"].add_geom(name="face/chest", type=_BOX, size=size, pos=centre, **_OUTSIDE)


def _add_capsule(body: mujoco.MjsBody, name: str, radius: float, ends: Sequence[float]) -> None:
    kind, size = mujoco.mjtGeom.mjGEOM_CAPSULE, (radius, 0, 0)
    body.add_geom(name=f"face/{name}", type=kind, size=size, fromto=ends, **_OUTSIDE)


def _add_lips(body: Mapping[str, mujoco.MjsBody], model: FaceModel) -> None:
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
            _add_capsule(body[owner], f"lip_{count}", _LIP_RADIUS, [*start, *end])
            count += 1
