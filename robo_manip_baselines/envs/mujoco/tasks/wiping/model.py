"""Cheek, residue and pad of the wiping task: their geometry, and their parts of the scene.

Points of the cheek are in the body frame of ``face/head`` (x out of the face, y to the person's
left, z up). Its *plane* has its origin in the middle of the residue, and the coordinates across
(along y) and up (along z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import FACE, SOLID
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel

Floats = NDArray[np.float64]

PATCH = (123, 50, 101, 36, 205, 203, 206, 147, 213, 187, 207, 216, 92, 100, 117, 118)
"""Landmarks of the right cheek, from the nose to the cheekbone. Their convex hull is what the pad
touches: it is within 1.2 mm of the surface under the residue, where the face's own geoms, some
ellipsoids, lie 4 to 40 mm below it. Landmarks 187, 207, 213 and 216 follow the jaw by 7 to 10 %,
the hull does not."""

PATCH_DEPTH = 0.03
"""m, thickness of the hull: more than a pad ever sinks in."""

CENTER_FROM_MOUTH = (-0.036, 0.036)
"""m across and up, from the mouth to the middle of the residue: on the cheek beside the nostril,
44 mm below the eye, where an opening jaw hardly moves the skin."""

HALF_SIDE = 0.0127
"""m, half the side of the square with residue: a square inch, as King et al. (IROS 2010) put on the
skin of their subjects."""

ROWS = 6
"""Rows and columns of cells, one spot in each."""

SPOTS = ROWS**2

PAD_RADIUS = 0.015
"""m, a cotton ball wrapped in cloth, as used to wash faces."""

PAD_FORWARD = 0.095
"""m from the site ``right/gripper`` to the pad's centre, along the gripper: long enough that the
fingers stay clear of the nose while the pad is beside it."""

PAD_STROKE = 0.020
"""m by which the foam behind the cloth can be pressed: two thirds of a thickness of 30 mm, where
open-cell foam has become solid."""

PAD_STIFFNESS = 200.0
"""N/m along the gripper: soft upholstery foam yields 40 % (12 mm of 30) under about 5 kPa (the
compression stress of ISO 3386-1), over the 5 cm² of the pad 2.4 N."""

PAD_DAMPING = 2.8
"""N s/m, 0.7 of critical for the pad's mass."""

PAD_MASS = 0.02
"""kg of pad and cloth."""

HANDLE_FINGER = 0.029
"""m, position of a finger on the handle, which is 16 mm thick."""

# A light body needs stiff contacts: MuJoCo's give way by acceleration, so that the face's own would
# let 20 g sink in by 20 mm. With these the skin yields by half a millimetre under 2 N.
_CONTACT = {"priority": 3, "solref": (0.01, 1.0), "solimp": (0.95, 0.95, 0.001, 0.5, 2.0)}
_FRICTION = (0.3, 0.005, 0.0001)  # that of the face: moist cloth slides on wet skin

_SPOT_SIZE = (0.0030, 0.0030, 0.0012)
_SPOT_COLOUR = (0.62, 0.16, 0.05, 1.0)
_PLASTIC, _FOAM, _CLOTH = (0.93, 0.93, 0.9, 1.0), (0.95, 0.86, 0.5, 1.0), (0.45, 0.72, 0.86, 1.0)


@dataclass(frozen=True)
class Cheek:
    """Surface of the right cheek, in the frame of ``face/head``, the jaw as open as at rest.

    Attributes:
        corners: (M, 3, 3) m, of the triangles around the residue.
        normals: (M, 3, 3), out of the face, at these corners.
        center: (2,) m, y and z of the middle of the residue.
        eyes: (2, 3) m, the middles of the lids.
        patch: (N, 3) m, vertices whose hull can be touched.
    """

    corners: Floats
    normals: Floats
    center: Floats
    eyes: Floats
    patch: Floats

    @classmethod
    @cache
    def load(cls) -> Cheek:
        """Cut the cheek out of the shipped face."""
        face = FaceModel.load()
        angle = face.jaw_angle(REST_OPENING)
        vertices = face.deform(angle)
        center = face.lip_centre(angle)[1:] + CENTER_FROM_MOUTH
        near = np.abs(vertices[:, 1:] - center).max(axis=-1) < 4 * HALF_SIDE
        triangles = face.triangles[near[face.triangles].any(axis=-1)]
        corners = vertices[face.triangles]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = np.zeros_like(vertices)
        for corner in range(3):
            np.add.at(normals, face.triangles[:, corner], across)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        front = vertices[list(PATCH)]
        return cls(
            corners=vertices[triangles],
            normals=normals[triangles],
            center=center,
            eyes=np.stack([vertices[face.rings[f"eye_{s}"]].mean(axis=0) for s in EYES]),
            patch=np.concatenate([front, front - [PATCH_DEPTH, 0.0, 0.0]]),
        )

    def at(self, plane: ArrayLike) -> tuple[Floats, Floats]:
        """Return point (3,) m and unit normal (3,) of the surface at ``plane`` (2,) m.

        Raises:
            ValueError: there is no cheek.
        """
        aim = self.center + np.asarray(plane, dtype=np.float64)
        origin, flat = self.corners[:, 0, 1:], self.corners[:, :, 1:]
        first, second = flat[:, 1] - origin, flat[:, 2] - origin
        area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        way = aim - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            b = (way[:, 0] * second[:, 1] - way[:, 1] * second[:, 0]) / area
            c = (first[:, 0] * way[:, 1] - first[:, 1] * way[:, 0]) / area
        share = np.stack([1.0 - b - c, b, c], axis=-1)
        inside = np.flatnonzero((share >= -1e-9).all(axis=-1))
        if not len(inside):
            raise ValueError(f"{plane}: not on the cheek")
        points = np.einsum("mc,mcx->mx", share[inside], self.corners[inside])
        front = int(points[:, 0].argmax())
        normal = share[inside[front]] @ self.normals[inside[front]]
        return points[front], normal / np.linalg.norm(normal)

    def draw_spots(self, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return points and normals, each (`SPOTS`, 3), one spot somewhere in each cell."""
        side = 2 * HALF_SIDE / ROWS
        cells = np.stack(np.meshgrid(np.arange(ROWS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
        planes = (cells + rng.uniform(0.15, 0.85, cells.shape)) * side - HALF_SIDE
        points, normals = zip(*map(self.at, planes), strict=True)
        return np.array(points), np.array(normals)


EYES = ("left", "right")


def add_cheek(scene: mujoco.MjSpec) -> None:
    """Add the touchable cheek ``wiping/cheek`` and sites ``wiping/spot_…`` to ``face/head``."""
    head = scene.body("face/head")
    patch = Cheek.load().patch
    scene.add_mesh(name="wiping/cheek", uservert=patch.ravel().tolist())
    head.add_geom(
        name="wiping/cheek",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="wiping/cheek",
        mass=0,
        group=3,
        contype=FACE,
        conaffinity=0,
        rgba=(0.9, 0.5, 0.2, 0.4),
        friction=_FRICTION,
        # What the face's own geoms have, for contacts with anything but the pad.
        priority=2,
        solref=(0.05, 1.0),
        solimp=(0.9, 0.9, 0.001, 0.5, 2.0),
    )
    for spot in range(SPOTS):
        head.add_site(
            name=f"wiping/spot_{spot}",
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            size=_SPOT_SIZE,
            pos=(0.05, 0.0, 0.0),
            rgba=_SPOT_COLOUR,
            group=1,
        )


def add_pad(scene: mujoco.MjSpec) -> None:
    """Add handle and pad to the right gripper; geom ``wiping/pad`` on the slide ``wiping/foam``.

    The slide's position is by how much the foam is pressed, m.
    """
    link = scene.body("right/gripper_link")
    site = float(scene.site("right/gripper").pos[0])
    end = site + PAD_FORWARD
    untouchable = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2, "rgba": _PLASTIC}
    box, capsule = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
    grip = (0.022, HANDLE_FINGER - 0.021, 0.011)
    link.add_geom(type=box, size=grip, pos=(site, 0, 0), **untouchable)
    stem = [site + grip[0], 0, 0, end - PAD_STROKE - 0.012, 0, 0]
    link.add_geom(type=capsule, size=(0.005, 0, 0), fromto=stem, **untouchable)
    pad = link.add_body(name="wiping/pad", pos=(end, 0, 0), gravcomp=1)
    pad.add_joint(
        name="wiping/foam",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=(-1, 0, 0),
        range=(0.0, PAD_STROKE),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        stiffness=PAD_STIFFNESS,
        damping=PAD_DAMPING,
    )
    foam = [-0.006, 0, 0, -PAD_STROKE - 0.008, 0, 0]
    pad.add_geom(type=capsule, size=(0.008, 0, 0), fromto=foam, **{**untouchable, "rgba": _FOAM})
    pad.add_geom(
        name="wiping/pad",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(PAD_RADIUS, 0, 0),
        mass=PAD_MASS,
        group=2,
        rgba=_CLOTH,
        contype=SOLID,
        conaffinity=SOLID | FACE,
        friction=_FRICTION,
        **_CONTACT,
    )


class ResidueSites:
    """Sites of a model that show the residue: they have no part in the physics.

    Args:
        model: compiled with `add_cheek`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._sites = np.array([model.site(f"wiping/spot_{n}").id for n in range(SPOTS)])

    def place(self, model: mujoco.MjModel, points: Floats, normals: Floats) -> None:
        """Show all spots, at points (S, 3) m with normals (S, 3), frame of ``face/head``."""
        model.site_sameframe[self._sites] = 0  # or MuJoCo would take some poses for the body's
        model.site_pos[self._sites] = points
        for site, normal in zip(self._sites, normals, strict=True):
            mujoco.mju_quatZ2Vec(model.site_quat[site], normal)
        model.site_rgba[self._sites, 3] = 1.0

    def hide(self, model: mujoco.MjModel, spots: frozenset[int]) -> None:
        """Show some spots no more."""
        model.site_rgba[self._sites[list(spots)], 3] = 0.0

    def show(self, model: mujoco.MjModel, is_there: ArrayLike) -> None:
        """Show the spots, (S,), that are there, and no others."""
        model.site_rgba[self._sites, 3] = is_there
