"""Put the face into a MuJoCo cell: bodies, skins, collision geoms and the site ``mouth``.

The shape and its kinematics are in `model`, the surfaces around the measured one in `mesh`, the
colours in `texture`, what can be touched in `collision`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import cv2
import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import mesh, physical
from robo_manip_baselines.envs.mujoco.face.collision import (
    Styles,
    add_collision,
    add_physical_collision,
    drawn_parts,
)
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
)

BODIES: Final = ("face/head", "face/jaw", "face/mouth", "face/torso")
"""Bodies, the keys of `FaceModel.body_poses`; mocap bodies and children of the world where the face
is visual."""

FACES: Final = ("visual", "physical")
"""Kinds of face. ``visual``: follows the recorded motion whatever touches it, and only robots touch
its outside. ``physical``: regions of soft tissue on a head that yields on a compliant neck."""

_ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID

_EYE_RADIUS: Final = 0.0122
_TEETH: Final = (0.88, 0.85, 0.78, 1.0)

_VISUAL: Final[dict[str, Any]] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}


def add_face(spec: mujoco.MjSpec, kind: str = "visual") -> None:
    """Add the face to ``spec``, at its nominal place, waiting to be fed.

    Bodies `BODIES`, site ``mouth`` on ``face/mouth`` (x axis: out of the face), skins and geoms
    named ``face/...``. Move it with `FaceModel.body_poses`; of the physical one, see
    `CompliantHead`. ``kind`` is one of `FACES`.
    """
    model = FaceModel.load()
    rest = model.body_poses(MOUTH_BASE, (1, 0, 0, 0), REST_OPENING)
    is_physical = kind == "physical"
    moving = physical.add_head(spec, model, rest) if is_physical else {}
    body = moving | {
        name.removeprefix("face/"): spec.worldbody.add_body(
            name=name, mocap=True, pos=at.tolist(), quat=turn.tolist()
        )
        for name, (at, turn) in rest.items()
        if name.removeprefix("face/") not in moving
    }
    touch = drawn_parts() if is_physical else {}
    body["mouth"].add_site(name="mouth", size=(0.002, 0.002, 0.002), rgba=(0, 0, 0, 0), group=4)
    _add_materials(spec)
    _add_skins(spec, model)
    _add_eyes(body["head"], model, touch)
    _add_ears(body["head"])
    _add_mouth_parts(spec, body["head"], body["jaw"], model, touch)
    _add_mesh(spec, body["head"], "hair", mesh.hair(model), _colour(HAIR))
    _add_mesh(spec, body["torso"], "shirt", mesh.bust(), (0.23, 0.42, 0.60, 1.0))
    if is_physical:
        add_physical_collision(body, model)
    else:
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
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    surface: Surface,
    rgba: tuple[float, ...],
    touch: Mapping[str, Any] | None = None,
) -> None:
    spec.add_mesh(
        name=f"face/{name}",
        uservert=surface.vertices.ravel().tolist(),
        userface=surface.triangles.ravel().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": f"face/{name}", "rgba": rgba}
    body.add_geom(name=f"face/{name}", **shape, **_VISUAL | dict(touch or {}))


def _add_eyes(head: mujoco.MjsBody, model: FaceModel, touch: Styles) -> None:
    for side in ("left", "right"):
        lids = model.vertices[model.rings[f"eye_{side}"]]
        centre = lids.mean(axis=0) - [_EYE_RADIUS - 0.0022, 0.0, 0.0]
        for part, radius, forward, rgba in (
            ("eye", _EYE_RADIUS, 0.0, (0.96, 0.95, 0.94, 1.0)),
            ("iris", 0.0064, _EYE_RADIUS - 0.0052, (0.30, 0.19, 0.11, 1.0)),
            ("pupil", 0.0034, _EYE_RADIUS - 0.0020, (0.03, 0.02, 0.02, 1.0)),
        ):
            name, place = f"face/{part}_{side}", centre + np.array([forward, 0.0, 0.0])
            style = _VISUAL | dict(touch.get(part, {}))
            head.add_geom(name=name, size=(radius, 0, 0), pos=place, rgba=rgba, **style)


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
    spec: mujoco.MjSpec,
    head: mujoco.MjsBody,
    jaw: mujoco.MjsBody,
    model: FaceModel,
    touch: Styles,
) -> None:
    lips = model.vertices[model.rings["lips_inner"]].mean(axis=0)
    upper = mesh.teeth(lips + np.array([-0.004, 0.0, 0.008]), -0.009)
    # the lower arch is smaller and bites behind the upper one
    foot = lips + np.array([-0.006, 0.0, -0.011]) - model.hinge
    lower = mesh.teeth(foot, 0.008, 0.019, 0.024)
    _add_mesh(spec, head, "teeth_upper", upper, _TEETH, touch.get("teeth"))
    _add_mesh(spec, jaw, "teeth_lower", lower, _TEETH, touch.get("teeth"))
    size, centre = (0.026, 0.017, 0.007), lips + np.array([-0.038, 0.0, -0.009]) - model.hinge
    shape = {"type": _ELLIPSOID, "size": size, "pos": centre, "rgba": (0.46, 0.19, 0.20, 1.0)}
    jaw.add_geom(name="face/tongue", **shape, **_VISUAL | dict(touch.get("tongue", {})))
