"""Geometry of the face: a measured 468-vertex surface with a jaw, and where its bodies go.

Frames. *Head frame* (of ``face_surface.npz``): x the viewer's right, y up, z out of the face.
*Body frame* (of the MuJoCo bodies ``face/...``): x out of the face, y the viewer's right, z up, so
that a face which looks along world +x has the identity quaternion. Metres, quaternions wxyz.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import ArrayType, FileType, read_npz

Floats = NDArray[np.float64]
Poses = dict[str, tuple[Floats, Floats]]

SURFACE = Path(__file__).with_name("assets") / "face_surface.npz"

SURFACE_FILE = FileType(
    "face_surface",
    1,
    {
        "vertices": ArrayType("f", (468, 3)),
        "triangles": ArrayType("i", ("M", 3), "not negative"),
        "jaw_weight": ArrayType("f", (468,), "not negative"),
        "jaw_hinge": ArrayType("f", (3,)),
        **{
            name: ArrayType("i", (size,), "not negative")
            for name, size in {
                "lips_outer": 20,
                "lips_inner": 20,
                "eye_left": 16,
                "eye_right": 16,
                "eyebrow_left": 10,
                "eyebrow_right": 10,
            }.items()
        },
        "metadata": ArrayType("U", is_optional=True),
    },
    limits={"M": 10_000},
)
"""Arrays of a surface file."""

REST_OPENING = 0.030
"""Distance between the inner lips, metres, of a person who waits to be fed: the jaw's recorded
opening is added to it. A spoonful takes 15-25 mm; a 4 cm cube is taken with the lips giving way."""

MAX_OPENING = 0.055
"""The jaw goes no further, metres: adults open 40-60 mm (between the incisors, unassisted)."""

UPPER_LIP, LOWER_LIP = 13, 14
"""Landmarks in the middle of the inner lips; their distance is the jaw opening."""

_TO_BODY = [2, 0, 1]
_RINGS = ("lips_outer", "lips_inner", "eye_left", "eye_right", "eyebrow_left", "eyebrow_right")


@dataclass(frozen=True)
class FaceModel:
    """The face's shape and kinematics. Arrays are in the body frame of ``face/head``.

    Attributes:
        vertices: (468, 3) m, mouth closed.
        triangles: (M, 3), counter-clockwise from outside; none in the mouth or the eyes.
        jaw_weight: (468,) 0..1, how far a vertex follows the jaw.
        hinge: (3,) m, a point on the jaw's axis (parallel to y).
        rings: vertex indices: lips_outer (20), lips_inner (20), eye_*, eyebrow_*.
    """

    vertices: Floats
    triangles: NDArray[np.int32]
    jaw_weight: Floats
    hinge: Floats
    rings: dict[str, NDArray[np.int64]]

    @classmethod
    def load(cls, path: Path = SURFACE) -> FaceModel:
        """Read a surface file.

        Raises:
            RequestError: the file is absent, damaged or of another schema.
        """
        remedy = "make it with: python -m face_prediction export-surface"
        arrays = read_npz(path, SURFACE_FILE, remedy=remedy)
        for name in ("triangles", *_RINGS):
            if arrays[name].size and arrays[name].max() >= len(arrays["vertices"]):
                raise RequestError(f"{path}: '{name}' names vertices that do not exist; {remedy}")
        return cls(
            vertices=arrays["vertices"].astype(float)[:, _TO_BODY],
            triangles=arrays["triangles"].astype(np.int32),
            jaw_weight=arrays["jaw_weight"].astype(float),
            hinge=arrays["jaw_hinge"].astype(float)[_TO_BODY],
            rings={name: arrays[name].astype(np.int64) for name in _RINGS},
        )

    @cached_property
    def lips(self) -> NDArray[np.int64]:
        """The 40 lip vertices whose mean is the mouth centre (paper, section IV.B)."""
        return np.concatenate([self.rings["lips_outer"], self.rings["lips_inner"]])

    def deform(self, angle: ArrayLike, index: ArrayLike | None = None) -> Floats:
        """Vertices (..., n, 3) m at jaw angles (...) rad: linear blend of head and jaw.

        ``index`` (n,) picks vertices; all of them by default.
        """
        chosen = slice(None) if index is None else np.asarray(index)
        vertices, weight = self.vertices[chosen], self.jaw_weight[chosen][:, None]
        turn = hinge_quaternion(np.asarray(angle, float)[..., None])
        turned = rotate(turn, vertices - self.hinge) + self.hinge
        return (1 - weight) * vertices + weight * turned

    def jaw_angle(self, jaw: ArrayLike) -> Floats:
        """Hinge angle (...) rad that brings the inner lips ``jaw`` (...) metres apart.

        Openings outside 0..`MAX_OPENING` are taken as the nearest of the two.
        """
        distance, angle = self._openings
        return np.asarray(np.interp(np.clip(jaw, 0.0, MAX_OPENING), distance, angle))

    def jaw_at(self, angle: ArrayLike) -> Floats:
        """Distance (...) m between the inner lips at jaw angles (...) rad: `jaw_angle` undone."""
        distance, table = self._openings
        return np.asarray(np.interp(np.asarray(angle, np.float64), table, distance))

    @cached_property
    def _openings(self) -> tuple[Floats, Floats]:
        """A table of lip distance (m, increasing) against hinge angle (rad)."""
        angle = np.linspace(0.0, 1.0, 1024)
        pair = self.deform(angle, [UPPER_LIP, LOWER_LIP])
        # signed, so that lips which touch or overlap by a hair do not fold the table
        axis = pair[-1, 0] - pair[-1, 1]
        distance = (pair[:, 0] - pair[:, 1]) @ axis / np.linalg.norm(axis)
        length = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
        distance = np.where(distance > 2e-3, length, distance)
        end = int(np.searchsorted(distance, MAX_OPENING))
        return distance[: end + 1], angle[: end + 1]

    def lip_centre(self, angle: ArrayLike) -> Floats:
        """Mean of the 40 lip vertices (..., 3) m at jaw angles (...) rad."""
        still, arm = self.lip_lever
        return still + rotate(hinge_quaternion(np.asarray(angle, float)), arm)

    @cached_property
    def lip_lever(self) -> tuple[Floats, Floats]:
        """(3,) m each: parts of the lips' centre that stay and that turn with the jaw."""
        vertices, weight = self.vertices[self.lips], self.jaw_weight[self.lips][:, None]
        still = ((1 - weight) * vertices + weight * self.hinge).mean(axis=0)
        return still, (weight * (vertices - self.hinge)).mean(axis=0)

    def body_poses(self, mouth: ArrayLike, orientation: ArrayLike, jaw: ArrayLike) -> Poses:
        """Poses of the mocap bodies that put the centre of the lips at ``mouth``.

        Args:
            mouth: (..., 3) m, world frame.
            orientation: (..., 4) wxyz, camera frame from head frame as recorded.
            jaw: (...) m between the inner lips, `REST_OPENING` included.

        Returns:
            Body name -> positions (..., 3) m and orientations (..., 4), world frame. The bust
            (``face/torso``) keeps still, upright, under the mean of all the mouth positions given.
        """
        return self.placed_bodies(mouth, world_from_body(orientation), jaw)

    def placed_bodies(self, mouth: ArrayLike, turn: ArrayLike, jaw: ArrayLike) -> Poses:
        """Poses as of `body_poses`, given the head's orientation (..., 4) wxyz, world from head."""
        mouth, turn = np.asarray(mouth, float), np.asarray(turn, float)
        angle = self.jaw_angle(jaw)
        head = mouth - rotate(turn, self.lip_centre(angle))
        torso = np.broadcast_to(mouth.reshape(-1, 3).mean(axis=0), mouth.shape).copy()
        upright = np.broadcast_to([1.0, 0.0, 0.0, 0.0], turn.shape).copy()
        return {
            "face/head": (head, turn),
            "face/jaw": (head + rotate(turn, self.hinge), multiply(turn, hinge_quaternion(angle))),
            "face/mouth": (mouth.copy(), turn.copy()),
            "face/torso": (torso, upright),
        }

    def opening_polygon(self, jaw: ArrayLike) -> Floats:
        """Inner lips (..., 20, 2), metres: y and z in the frame of the site ``mouth``.

        A closed polygon in order around the opening, at lip distances ``jaw`` (...).
        """
        angle = self.jaw_angle(jaw)
        ring = self.deform(angle, self.rings["lips_inner"])
        return (ring - self.lip_centre(angle)[..., None, :])[..., 1:]

    def opening(self, jaw: ArrayLike) -> tuple[Floats, Floats]:
        """(half width, half height) (...) m of the opening between the inner lips."""
        polygon = self.opening_polygon(jaw)
        half = (polygon.max(axis=-2) - polygon.min(axis=-2)) / 2
        return half[..., 0], half[..., 1]


def world_from_body(orientation: ArrayLike) -> Floats:
    """Body orientation in the world (..., 4) of a recorded camera-from-head one (..., 4), wxyz.

    World and body frame rename the camera's and the head's axes by the same cyclic exchange
    (x, y, z) -> (z, x, y), so the rotation's axis goes through that exchange too.
    """
    quat = np.asarray(orientation, float)[..., [0, 3, 1, 2]]
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def hinge_quaternion(angle: Floats) -> Floats:
    """Quaternion (..., 4) of a jaw opened by ``angle`` (...) rad: about +y, chin down and back."""
    quat = np.zeros((*np.shape(angle), 4))
    quat[..., 0], quat[..., 2] = np.cos(angle / 2), np.sin(angle / 2)
    return quat


def rotate(quat: Floats, vector: Floats) -> Floats:
    """``vector`` (..., 3) turned by unit quaternions (..., 4)."""
    axis, twice = quat[..., 1:], 2 * np.cross(quat[..., 1:], vector)
    return vector + quat[..., :1] * twice + np.cross(axis, twice)


def multiply(first: Floats, second: Floats) -> Floats:
    """Product (..., 4) of quaternions (..., 4): ``second`` is applied first."""
    a, u = first[..., :1], first[..., 1:]
    b, v = second[..., :1], second[..., 1:]
    scalar = a * b - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, a * v + b * u + np.cross(u, v)], axis=-1)
