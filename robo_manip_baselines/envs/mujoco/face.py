"""The face: a measured 468-vertex surface with a jaw, placed by recorded motion.

Frames. *Head frame* (of ``face_surface.npz``): x the viewer's right, y up, z out of the face.
*Body frame* (of the MuJoCo bodies): x out of the face, y the viewer's right, z up, so that a face
that looks along world +x has the identity quaternion. Lengths in metres, quaternions wxyz.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

SURFACE = Path(__file__).parent / "assets" / "face_surface.npz"
REST_OPENING = 0.030
MAX_OPENING = 0.055

Poses = dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def _to_body(v):
    return np.asarray(v, float)[..., [2, 0, 1]]


def _rotate(quat, vec):
    """Rotate vec (…,3) by quat (…,4)."""
    w, u = quat[..., :1], quat[..., 1:]
    t = 2 * np.cross(u, vec)
    return vec + w * t + np.cross(u, t)


def _multiply(a, b):
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return np.concatenate(
        [aw * bw - (av * bv).sum(-1, keepdims=True), aw * bv + bw * av + np.cross(av, bv)], -1
    )


def _hinge_quat(angle):
    q = np.zeros((*np.shape(angle), 4))
    q[..., 0] = np.cos(angle / 2)
    q[..., 2] = np.sin(angle / 2)
    return q


@dataclass(frozen=True)
class FaceModel:
    """Geometry of the face and where its bodies go. Arrays are in the body frame."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    jaw_weight: NDArray[np.float64]
    hinge: NDArray[np.float64]
    rings: dict[str, NDArray[np.int64]]

    @classmethod
    def load(cls, path: Path = SURFACE) -> FaceModel:
        with np.load(path, allow_pickle=False) as f:
            rings = {
                k: f[k].astype(np.int64)
                for k in (
                    "lips_outer",
                    "lips_inner",
                    "eye_left",
                    "eye_right",
                    "eyebrow_left",
                    "eyebrow_right",
                )
            }
            return cls(
                _to_body(f["vertices"]),
                f["triangles"],
                f["jaw_weight"].astype(float),
                _to_body(f["jaw_hinge"]),
                rings,
            )

    def deform(self, angle: ArrayLike, index=slice(None)):
        """Vertices (…, n, 3) in the head body's frame at jaw angles (…)."""
        angle = np.asarray(angle, float)[..., None]
        v, w = self.vertices[index], self.jaw_weight[index][:, None]
        turned = _rotate(_hinge_quat(angle), v - self.hinge) + self.hinge
        return (1 - w) * v + w * turned

    def jaw_angle(self, jaw: ArrayLike):
        """Hinge angle (rad) that brings landmarks 13 and 14 ``jaw`` metres apart."""
        table, angles = self._table()
        return np.interp(np.asarray(jaw, float), table, angles)

    def _table(self):
        return _table(self)

    def lip_centre(self, angle: ArrayLike):
        """Mean of the 40 lip vertices (…,3) in the head body's frame."""
        lips = np.concatenate([self.rings["lips_outer"], self.rings["lips_inner"]])
        v, w = self.vertices[lips], self.jaw_weight[lips][:, None]
        fixed = ((1 - w) * v + w * self.hinge).mean(0)
        return fixed + _rotate(_hinge_quat(np.asarray(angle, float)), (w * (v - self.hinge)).mean(0))

    def body_poses(self, mouth: ArrayLike, orientation: ArrayLike, jaw: ArrayLike) -> Poses:
        mouth = np.asarray(mouth, float)
        q = np.asarray(orientation, float)[..., [0, 3, 1, 2]]
        q = q / np.linalg.norm(q, axis=-1, keepdims=True)
        angle = self.jaw_angle(jaw)
        head = mouth - _rotate(q, self.lip_centre(angle))
        torso = np.broadcast_to(mouth.reshape(-1, 3).mean(0), mouth.shape)
        up = np.broadcast_to(np.array([1.0, 0, 0, 0]), q.shape)
        return {
            "face/head": (head, q),
            "face/jaw": (head + _rotate(q, self.hinge), _multiply(q, _hinge_quat(angle))),
            "face/mouth": (mouth, q),
            "face/torso": (torso, up),
        }

    def opening_polygon(self, jaw: ArrayLike):
        """Inner lip ring (…, 20, 2): y and z in the mouth frame, metres."""
        angle = self.jaw_angle(jaw)
        ring = self.deform(angle, self.rings["lips_inner"])
        return (ring - self.lip_centre(angle)[..., None, :])[..., 1:]

    def opening(self, jaw: ArrayLike):
        """(half_width, half_height) of the opening between the inner lips, metres."""
        p = self.opening_polygon(jaw)
        half = (p.max(axis=-2) - p.min(axis=-2)) / 2
        return half[..., 0], half[..., 1]


def _table(model):
    angles = np.linspace(0, 0.9, 512)
    up, low = model.deform(angles, [13]), model.deform(angles, [14])
    d = np.linalg.norm(up - low, axis=-1)[:, 0]
    d[0] = min(d[0], 0.0)
    d = np.maximum.accumulate(d) + np.arange(512) * 1e-9
    stop = np.searchsorted(d, MAX_OPENING) + 1
    return d[:stop], angles[:stop]


SKIN = (0.86, 0.66, 0.55, 1)
LIPS = (0.76, 0.32, 0.32, 1)
HAIR = (0.22, 0.14, 0.09, 1)


def _skin(spec, name, model, tris, rgba, push=0.0):
    used, inv = np.unique(tris, return_inverse=True)
    v = model.vertices[used].copy()
    v[:, 0] += push
    w = model.jaw_weight[used]
    spec.add_skin(
        name=name,
        rgba=rgba,
        vert=v.ravel().tolist(),
        face=inv.reshape(-1).tolist(),
        bodyname=["face/head", "face/jaw"],
        bindpos=[0.0, 0.0, 0.0, *model.hinge.tolist()],
        bindquat=[1, 0, 0, 0, 1, 0, 0, 0],
        vertid=[list(range(len(used)))] * 2,
        vertweight=[(1 - w).tolist(), w.tolist()],
    )


def _lip_triangles(model):
    """Mask of the triangles between the outer and the inner lip ring."""
    inside = set(model.rings["lips_inner"].tolist())
    wall = set(model.rings["lips_outer"].tolist())
    mask = np.zeros(len(model.triangles), bool)
    grown = True
    while grown:
        new = np.array([bool(inside & set(t)) for t in model.triangles.tolist()]) & ~mask
        grown = new.any()
        mask |= new
        inside |= set(model.triangles[new].ravel().tolist()) - wall
    return mask


OUTER = dict(contype=2, conaffinity=0)
CAVITY = dict(contype=4, conaffinity=0)
VISUAL = dict(contype=0, conaffinity=0)


def add_face(spec: mujoco.MjSpec) -> None:
    """Add the face to a cell: mocap bodies, skins, collision geoms and the site ``mouth``."""
    model = FaceModel.load()
    g = mujoco.mjtGeom
    rest = model.body_poses([0.0, 0.5, 0.35], [1, 0, 0, 0], REST_OPENING)
    bodies = {
        k: spec.worldbody.add_body(name=k, mocap=True, pos=p, quat=q) for k, (p, q) in rest.items()
    }
    head, jaw, mouth, torso = (bodies[f"face/{k}"] for k in ("head", "jaw", "mouth", "torso"))
    mouth.add_site(name="mouth", size=[0.002, 0.002, 0.002], rgba=[0, 0, 0, 0], group=4)

    lip_tri = _lip_triangles(model)
    _skin(spec, "face/lips", model, model.triangles[lip_tri], LIPS)
    _skin(spec, "face/skin", model, model.triangles[~lip_tri], SKIN)
    # eyes
    for side in ("left", "right"):
        ring = model.vertices[model.rings[f"eye_{side}"]]
        c = ring.mean(0)
        head.add_geom(type=g.mjGEOM_SPHERE, size=[0.0125, 0, 0], pos=c - [0.0105, 0, 0],
                      rgba=[0.95, 0.94, 0.92, 1], mass=0, **VISUAL)
        head.add_geom(type=g.mjGEOM_SPHERE, size=[0.0068, 0, 0], pos=c - [0.0042, 0, 0],
                      rgba=[0.25, 0.16, 0.1, 1], mass=0, **VISUAL)
        b = model.vertices[model.rings[f"eyebrow_{side}"]]
        b = b[np.argsort(b[:, 1])]
        for i in range(0, len(b) - 2, 2):
            head.add_geom(type=g.mjGEOM_CAPSULE, size=[0.003, 0, 0],
                          fromto=np.concatenate([b[i : i + 2].mean(0), b[i + 2 : i + 4].mean(0)]),
                          rgba=HAIR, mass=0, **VISUAL)
    # skull, hair, neck
    def ell(body, size, pos, rgba, **k):
        body.add_geom(type=g.mjGEOM_ELLIPSOID, size=size, pos=pos, rgba=rgba, mass=0, **k)

    ell(head, [0.085, 0.074, 0.095], [-0.045, 0, 0.02], SKIN, **OUTER)
    ell(head, [0.088, 0.080, 0.085], [-0.052, 0, 0.045], HAIR, **OUTER)
    ell(head, [0.022, 0.012, 0.03], [0.052, 0, -0.005], (0, 0, 0, 0), **OUTER)
    for s in (-1, 1):
        ell(head, [0.012, 0.006, 0.03], [-0.02, s * 0.08, 0.01], SKIN, **VISUAL)
    head.add_geom(type=g.mjGEOM_CAPSULE, size=[0.052, 0, 0], rgba=SKIN, mass=0,
                  fromto=[-0.055, 0, -0.02, -0.075, 0, -0.16], **OUTER)
    # torso, relative to the mean mouth
    ell(torso, [0.075, 0.2, 0.2], [-0.125, 0, -0.33], (0.25, 0.4, 0.55, 1), **OUTER)
    # lips
    angle = model.jaw_angle(REST_OPENING)
    v = model.deform(angle)
    hq = _hinge_quat(angle)
    inv = hq * [1, -1, -1, -1]
    upper = [(78, 191), (80, 81), (82, 13), (13, 312), (311, 310), (415, 308)]
    lower = [(78, 95), (88, 178), (87, 14), (14, 317), (402, 318), (324, 308)]
    ring_in, ring_out = list(model.rings["lips_inner"]), list(model.rings["lips_outer"])
    n = 0
    for body, chain in ((head, [78, 80, 82, 312, 310, 308]), (jaw, [308, 318, 317, 87, 88, 78])):
        pts = []
        for k in chain:
            mid = 0.5 * (v[k] + v[ring_out[ring_in.index(k)]]) - [0.004, 0, 0]
            pts.append(mid)
        for a, b in zip(pts, pts[1:]):
            if body is jaw:
                a, b = (_rotate(inv, x - model.hinge) for x in (a, b))
            body.add_geom(name=f"face/lip_{n}", type=g.mjGEOM_CAPSULE, size=[0.004, 0, 0],
                          fromto=np.concatenate([a, b]), rgba=[0, 0, 0, 0], mass=0, **OUTER)
            n += 1
    # cavity
    def box(name, size, pos, quat=(1, 0, 0, 0)):
        mouth.add_geom(name=name, type=g.mjGEOM_BOX, size=size, pos=pos, quat=quat, mass=0,
                       rgba=[0, 0, 0, 0], friction=[1, 0.005, 0.0001], **CAVITY)

    box("face/tongue_floor", [0.036, 0.034, 0.006], [-0.037, 0, -0.036], (0.9994, 0, -0.035, 0))
    box("face/cheek_left", [0.035, 0.005, 0.035], [-0.045, -0.038, 0])
    box("face/cheek_right", [0.035, 0.005, 0.035], [-0.045, 0.038, 0])
    box("face/throat", [0.005, 0.034, 0.035], [-0.083, 0, 0])
    box("face/palate", [0.035, 0.034, 0.005], [-0.045, 0, 0.042])
    # dark mouth
    ell(head, [0.002, 0.045, 0.045], [0.012, 0, -0.055], (0.18, 0.04, 0.04, 1), **VISUAL)
