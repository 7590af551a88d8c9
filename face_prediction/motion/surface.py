"""The mean face and its jaw from many real faces, and MediaPipe's mesh: functions on arrays.

Frames are lifted to metres, aligned over the parts of a face that keep still when it speaks, and
read off where the lips touch; the motion of vertices as the mouth opens gives the jaw.

Legend: T frames, V = 468 vertices, E edges, H head frame (metres; x the viewer's right, y up, z
out of the face; axes of MediaPipe's canonical face), w a vertex's share of the jaw's rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from face_prediction.tracking.geometry import (
    LOWER_INNER_LIP,
    UPPER_INNER_LIP,
    image_rays,
    view_size,
)
from face_prediction.tracking.tracks import Size
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command

CANONICAL_MEAN = np.array([0.0, -0.00676, 0.04159])
"""Mean of the 468 vertices of the canonical face that the head pose was fitted to (metres, head
frame; ``canonical_face_model.obj`` of MediaPipe, Apache-2.0)."""

STILL_ABOVE = -0.005
"""Vertices above this height (head frame, metres: the nostrils) keep still when the mouth moves."""

LIP_CORNERS = (78, 308)
"""Corners of the inner lips: their distance tells a smile from an opening."""

# Anchors of the jaw weight. The lip rows are the inner edge and, in the same order, the outer edge.
_UPPER_LIP = (80, 81, 82, 13, 312, 311, 310, 40, 39, 37, 0, 267, 269, 270)
_LOWER_LIP = (88, 178, 87, 14, 317, 402, 318, 91, 181, 84, 17, 314, 405, 321)
_NOSE_BASE = 2
_LOWER_LIP_EDGE = 17
# From the jaw's centre of rotation to the lower lip, metres: Bonwill's triangle (joint to lower
# incisors, 4 inches) less what the joint slides forward on opening.
_LEVER = 0.090
# Metres of opening at which the measured direction of motion is taken to hold.
_TYPICAL_OPENING = 0.020
# The chin is bone: as much of it as lies this far below the lower lip and this near the middle.
_CHIN_BELOW, _CHIN_HALF_WIDTH = 0.012, 0.030
# How much the measured weights count against smoothness, and the anchors against both.
_DATA, _ANCHOR = 0.15, 100.0


@dataclass(frozen=True)
class Topology:
    """Mesh of MediaPipe's 468 vertices.

    Attributes:
        triangles: (M, 3) int32, counter-clockwise from outside; none in the mouth or the eyes.
        groups: ordered rings and sorted lists of vertices, by the names of the surface file.
    """

    triangles: np.ndarray
    groups: dict[str, np.ndarray]

    @property
    def edges(self) -> np.ndarray:
        """Every edge once, (E, 2)."""
        sides = np.concatenate([self.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        return np.unique(np.sort(sides, axis=1), axis=0)


@dataclass(frozen=True)
class JawFit:
    """The jaw: a hinge and the share of its rotation that each vertex follows.

    Attributes:
        hinge: (3,) metres, a point on the axis (parallel to x), head frame.
        weight: (V,) 0..1, regularised.
        measured: (V,) as regressed on the clips, the lower lip's being 1.
    """

    hinge: np.ndarray
    weight: np.ndarray
    measured: np.ndarray


def metric_landmarks(landmarks: np.ndarray, head_pose: np.ndarray, image_size: Size) -> np.ndarray:
    """Lift landmarks (T, V, 3) to metres in the head frame.

    MediaPipe's z is a depth on the scale of x, relative to the face's mean distance; the head
    pose says what that distance is (``face_geometry/libs/geometry_pipeline.cc``, undone).
    ``landmarks`` are normalised image coordinates and relative depth / image width, ``head_pose``
    (T, 4, 4) metres, camera from head.
    """
    points = np.asarray(landmarks, dtype=float)
    rays = image_rays(points, image_size)
    rotation, translation = head_pose[:, :3, :3], head_pose[:, :3, 3]
    distance = -(rotation @ CANONICAL_MEAN + translation)[:, 2]
    relative = points[..., 2] * view_size(image_size)[0]
    depth = (1 + relative - relative.mean(axis=1, keepdims=True)) * distance[:, None]
    return (rays * depth[..., None] - translation[:, None]) @ rotation


def align(faces: np.ndarray, reference: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Turn and shift faces (T, V, 3) so that their ``still`` vertices lie best on the reference's.

    No scaling: the size of a face comes from the head pose; one camera does not measure it.
    """
    middle = faces[:, still].mean(axis=1, keepdims=True)
    goal = reference[still].mean(axis=0)
    centred = np.swapaxes(faces[:, still] - middle, 1, 2)
    u, _, vt = np.linalg.svd(centred @ (reference[still] - goal))
    flip = np.broadcast_to(np.eye(3), u.shape).copy()
    flip[:, 2, 2] = np.linalg.det(u @ vt)
    return (faces - middle) @ (u @ flip @ vt) + goal


def align_subjects(subjects: Sequence[np.ndarray], rounds: int = 5) -> list[np.ndarray]:
    """Align every subject's faces (T, V, 3) to the mean over subjects, found by iteration."""
    reference = np.mean([faces.mean(axis=0) for faces in subjects], axis=0)
    still = np.flatnonzero(reference[:, 1] > STILL_ABOVE)
    aligned = list(subjects)
    for _ in range(rounds):
        aligned = [align(faces, reference, still) for faces in aligned]
        reference = np.mean([faces.mean(axis=0) for faces in aligned], axis=0)
    return aligned


def lip_distance(faces: np.ndarray) -> np.ndarray:
    """Distance (T,) in metres between the inner lips."""
    return np.linalg.norm(faces[:, UPPER_INNER_LIP] - faces[:, LOWER_INNER_LIP], axis=-1)


def opening_velocity(aligned: Sequence[np.ndarray]) -> np.ndarray:
    """Motion of vertices per metre of jaw opening (V, 3), within subjects.

    Ordinary least squares on the deviations from each subject's own mean, with the width of the
    mouth as a second regressor so that smiles are not taken for openings.
    """
    products = np.zeros((2, aligned[0][0].size))
    gram = np.zeros((2, 2))
    for faces in aligned:
        corners = faces[:, LIP_CORNERS[0]] - faces[:, LIP_CORNERS[1]]
        regressors = np.stack([lip_distance(faces), np.linalg.norm(corners, axis=-1)])  # (2, T)
        regressors -= regressors.mean(axis=1, keepdims=True)
        products += regressors @ (faces - faces.mean(axis=0)).reshape(len(faces), -1)
        gram += regressors @ regressors.T
    return np.linalg.solve(gram, products)[0].reshape(-1, 3)


def closed_mean(aligned: Sequence[np.ndarray], velocity: np.ndarray) -> np.ndarray:
    """The mean over subjects (V, 3) of their faces as they are with the lips together."""
    return np.mean(
        [faces.mean(axis=0) - lip_distance(faces).mean() * velocity for faces in aligned], axis=0
    )


def mirror_partners(vertices: np.ndarray) -> np.ndarray:
    """For every vertex (V,) the one on the other side of the face; itself on the midline."""
    from scipy.optimize import linear_sum_assignment  # slow to import

    mirrored = vertices * (-1, 1, 1)
    distance = ((vertices[:, None] - mirrored) ** 2).sum(axis=-1)
    partner = linear_sum_assignment(distance + distance.T)[1]
    if not np.array_equal(partner[partner], np.arange(len(vertices))):
        raise ValueError("the face is too lopsided to pair its two sides")
    return partner


def symmetric(values: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Mean of ``values`` (V, 3) and their mirror image."""
    return (values + values[partner] * (-1, 1, 1)) / 2


def fit_jaw(vertices: np.ndarray, velocity: np.ndarray, edges: np.ndarray) -> JawFit:
    """Hinge and weights that explain how ``vertices`` (V, 3) move per metre of opening (V, 3).

    The hinge lies on the normal to the lower lip's measured path, a jaw's length behind it. (Where
    the normals of all vertices meet would be a worse guess: skin slides over the bone, and the
    mesh lets the chin follow the lips only half way.) Weights are the measured motion relative to
    a rotation about the hinge, made smooth over ``edges`` (E, 2) and anchored: the upper lip and
    all above the nose's base at 0, the lower lip and the chin, which is bone, at 1.
    """
    lip = list(_LOWER_LIP)
    path = velocity[lip, 1:].mean(axis=0)  # (up, forward) per metre of opening
    halfway = vertices[lip, 1:].mean(axis=0) + path * _TYPICAL_OPENING / 2
    forward = np.array([path[1], -path[0]]) / np.linalg.norm(path)
    hinge = np.array([0.0, *(halfway - _LEVER * forward)])
    turning = np.cross((1.0, 0.0, 0.0), vertices - hinge)  # velocity per radian of a rigid jaw
    share = (velocity * turning).sum(axis=1) / (turning**2).sum(axis=1)
    measured = share / share[lip].mean()
    return JawFit(hinge, _smooth_weight(vertices, measured, edges), measured)


def _smooth_weight(vertices: np.ndarray, measured: np.ndarray, edges: np.ndarray) -> np.ndarray:
    anchors = np.full(len(vertices), np.nan)
    anchors[vertices[:, 1] > vertices[_NOSE_BASE, 1]] = 0.0
    anchors[list(_UPPER_LIP)] = 0.0
    anchors[list(_LOWER_LIP)] = 1.0
    chin = vertices[:, 1] < vertices[_LOWER_LIP_EDGE, 1] - _CHIN_BELOW
    anchors[chin & (np.abs(vertices[:, 0]) < _CHIN_HALF_WIDTH)] = 1.0
    anchored = ~np.isnan(anchors)

    stiffness = 0.01 / np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    laplacian = np.zeros((len(vertices), len(vertices)))
    np.add.at(laplacian, (edges[:, 0], edges[:, 1]), -stiffness)
    laplacian += laplacian.T
    laplacian -= np.diag(laplacian.sum(axis=1))
    pull = _DATA + _ANCHOR * anchored
    goal = _DATA * np.clip(measured, 0.0, 1.0) + _ANCHOR * np.where(anchored, anchors, 0.0)
    return np.clip(np.linalg.solve(laplacian @ laplacian + np.diag(pull), goal), 0.0, 1.0)


def measure(subjects: Sequence[np.ndarray], topology: Topology) -> tuple[np.ndarray, JawFit]:
    """The symmetric mean face (468, 3) with its mouth closed, and its jaw.

    Raises:
        RequestError: nobody opens the mouth.
    """
    if max(float(np.ptp(lip_distance(faces))) for faces in subjects) < 0.005:
        raise RequestError("no mouth opens by more than 5 mm; add clips of people who speak")
    aligned = align_subjects(subjects)
    velocity = opening_velocity(aligned)
    mean = closed_mean(aligned, velocity)
    partner = mirror_partners(mean)
    vertices, velocity = symmetric(mean, partner), symmetric(velocity, partner)
    fit = fit_jaw(vertices, velocity, topology.edges)
    weight = (fit.weight + fit.weight[partner]) / 2
    return vertices, JawFit(fit.hinge, weight, fit.measured)


def mediapipe_topology() -> Topology:
    """Triangles and groups as MediaPipe lists them.

    Raises:
        RequestError: MediaPipe is not installed.
    """
    try:
        from mediapipe.tasks.python.vision import FaceLandmarksConnections as Mesh
    except ImportError:
        raise RequestError(
            "export-surface takes the triangles from MediaPipe, which is not installed; "
            f"run: {install_command('face-prediction')}"
        ) from None

    def pairs(connections: Any) -> np.ndarray:
        return np.array([(edge.start, edge.end) for edge in connections])

    loops = ordered_loops(pairs(Mesh.FACE_LANDMARKS_LIPS))
    groups = {
        "lips_outer": next(loop for loop in loops if 0 in loop),
        "lips_inner": next(loop for loop in loops if 13 in loop),
        "eye_left": ordered_loops(pairs(Mesh.FACE_LANDMARKS_LEFT_EYE))[0],
        "eye_right": ordered_loops(pairs(Mesh.FACE_LANDMARKS_RIGHT_EYE))[0],
        "eyebrow_left": np.unique(pairs(Mesh.FACE_LANDMARKS_LEFT_EYEBROW)).tolist(),
        "eyebrow_right": np.unique(pairs(Mesh.FACE_LANDMARKS_RIGHT_EYEBROW)).tolist(),
    }
    # the list of edges goes round one triangle after the other
    triangles = pairs(Mesh.FACE_LANDMARKS_TESSELATION).reshape(-1, 3, 2)[:, :, 0]
    arrays = {name: np.array(group) for name, group in groups.items()}
    return Topology(triangles.astype(np.int32), arrays)


def ordered_loops(edges: np.ndarray) -> list[list[int]]:
    """The closed loops that edges (E, 2) form, each as an ordered list of vertices."""
    beside: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    loops: list[list[int]] = []
    while beside:
        loop = [next(iter(beside))]
        while ahead := [v for v in beside.pop(loop[-1]) if v in beside and v not in loop]:
            loop.append(ahead[0])
        loops.append(loop)
    return loops


def facing_out(triangles: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The same triangles (M, 3), all counter-clockwise seen from outside.

    Neighbours are made to agree edge by edge; then the whole is turned if it faces inward.
    """
    sides: dict[tuple[int, int], list[int]] = {}
    for i, (a, b, c) in enumerate(triangles.tolist()):
        for pair in ((a, b), (b, c), (c, a)):
            sides.setdefault((min(pair), max(pair)), []).append(i)
    result, done, queue = triangles.copy(), {0}, [0]
    while queue:
        a, b, c = result[queue[-1]].tolist()
        queue.pop()
        for start, end in ((a, b), (b, c), (c, a)):
            for i in sides[min(start, end), max(start, end)]:
                if i in done:
                    continue
                p, q, r = result[i].tolist()
                if (start, end) in ((p, q), (q, r), (r, p)):
                    result[i] = (p, r, q)
                done.add(i)
                queue.append(i)
    corner = vertices[result]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return result if normal[:, 2].sum() > 0 else result[:, [0, 2, 1]]
