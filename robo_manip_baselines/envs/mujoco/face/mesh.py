"""Surfaces around the measured face: the rest of the head, hair, neck, bust, mouth and teeth.

Each function returns a `Surface` in the frame of the body it hangs on. They are plain lofts: rings
of points joined by strips of triangles. Legend: R rings, N points a ring. Lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face.model import FaceModel

Floats = NDArray[np.float64]

SKULL_CENTRE = np.array([-0.052, 0.0, 0.022])
SKULL_RADII = np.array([0.102, 0.0765, 0.098])
"""An ellipsoid as long (204 mm with hair), wide (153 mm) and high as an adult's braincase
(Farkas, Anthropometry of the Head and Face, 1994: length 187-197, width 141-151 mm)."""

HAIR_THICKNESS = 0.010

_LINING = (
    # behind the lips m, width and height relative to the lips' edge, widened up and down by m
    (0.000, 1.00, 0.000),
    (0.003, 1.06, 0.003),
    (0.010, 1.15, 0.010),
    (0.030, 1.10, 0.012),
    (0.050, 0.70, 0.008),
    (0.053, 0.00, 0.000),
)
"""Rings of the mouth's inside; the last one closes it."""


@dataclass(frozen=True)
class Surface:
    """Triangles, counter-clockwise from outside, and each vertex's share of the second bone."""

    vertices: Floats  # (V, 3)
    triangles: NDArray[np.int32]  # (F, 3)
    weight: Floats  # (V,) 0..1


def strips(rings: int, points: int, closed: bool = True) -> NDArray[np.int32]:
    """Triangles (F, 3) that join consecutive rings; the next ring lies to the left of a ring."""
    span = points if closed else points - 1
    first = (np.arange(rings - 1)[:, None] * points + np.arange(span)).ravel()
    second = (np.arange(rings - 1)[:, None] * points + (np.arange(span) + 1) % points).ravel()
    up_first, up_second = first + points, second + points
    return np.concatenate(
        [np.stack([first, second, up_second], 1), np.stack([first, up_second, up_first], 1)]
    ).astype(np.int32)


def loft(rings: Floats, weight: Floats, closed: bool = True) -> Surface:
    """Join rings (R, N, 3) of vertices with weights (R, N)."""
    count, points = rings.shape[:2]
    return Surface(rings.reshape(-1, 3), strips(count, points, closed), weight.reshape(-1))


def face_oval(model: FaceModel) -> NDArray[np.int64]:
    """The outline of the measured face as an ordered ring, counter-clockwise from the front."""
    edges = {}
    for a, b, c in model.triangles.tolist():
        for start, end in ((a, b), (b, c), (c, a)):
            edges[start, end] = (end, start)
    border = {a: b for (a, b), back in edges.items() if back not in edges}
    ring = [int(np.argmax(model.vertices[:, 2]))]
    while border[ring[-1]] != ring[0]:
        ring.append(border[ring[-1]])
    return np.array(ring)


def _skull_rings(start: Floats, steps: Floats, swell: Floats) -> Floats:
    """Rings (R, N, 3) from the outline ``start`` (N, 3) over the skull to its back.

    ``steps`` (R,) runs from 0 (the outline) to 1 (the back); ``swell`` (R, N) metres is added
    along the ellipsoid's radius.
    """
    around = np.arctan2(start[:, 1] - SKULL_CENTRE[1], start[:, 2] - SKULL_CENTRE[2])
    first = np.arccos(np.clip((start[:, 0] - SKULL_CENTRE[0]) / SKULL_RADII[0], -1.0, 1.0))
    latitude = first + (np.pi - first) * steps[:, None]
    direction = np.stack(
        [
            np.cos(latitude),
            np.sin(latitude) * np.sin(around),
            np.sin(latitude) * np.cos(around),
        ],
        axis=-1,
    )
    on_skull = SKULL_CENTRE + SKULL_RADII * direction
    gap = (start - on_skull[0]) * ((1 - steps) ** 2)[:, None, None]
    return on_skull + gap + swell[..., None] * direction


def head(model: FaceModel) -> Surface:
    """The measured face (vertices 0 to 467) and, from its outline on, the skull to its back.

    Face and skull share the outline's vertices, so that no edge shows between them.
    """
    outline = face_oval(model)[::-1]
    count, steps = len(outline), np.linspace(0.0, 1.0, 8)
    rings = _skull_rings(model.vertices[outline], steps, np.zeros((8, count)))
    weight = model.jaw_weight[outline] * ((1 - steps) ** 2)[:, None]
    number = np.concatenate([outline, len(model.vertices) + np.arange(7 * count)])
    return Surface(
        np.concatenate([model.vertices, rings[1:].reshape(-1, 3)]),
        np.concatenate([model.triangles, number[strips(8, count)]]).astype(np.int32),
        np.concatenate([model.jaw_weight, weight[1:].ravel()]),
    )


def hair(model: FaceModel) -> Surface:
    """Short hair: the skull swollen behind the hairline and sunk under the skin before it."""
    start = model.vertices[face_oval(model)].copy()
    # the jaw has no hair, and would leave it behind when it opens: begin at the ears' height
    low = start[:, 2] < -0.01
    start[low] = SKULL_CENTRE + (start[low] - SKULL_CENTRE) * [0.3, 0.9, 0.6]
    steps = np.linspace(0.0, 1.0, 14)
    around = np.abs(np.arctan2(start[:, 1], start[:, 2] - SKULL_CENTRE[2]))  # 0 up, pi down
    # where hair begins: at the outline on top, behind the ear at the side, low at the nape
    hairline = np.interp(
        around, np.deg2rad([0, 45, 80, 105, 140, 180]), [0, 0, 0.1, 0.42, 0.62, 0.66]
    )
    depth = steps[:, None] - hairline
    swell = HAIR_THICKNESS * np.clip(depth / 0.12, -0.8, 1.0)
    rings = _skull_rings(start, steps, swell)
    return loft(rings[:, ::-1], np.zeros(rings.shape[:2]))


def mouth_lining(model: FaceModel) -> Surface:
    """The inside of lips and cheeks: from the inner lips back to the throat, seen from within."""
    ring = model.rings["lips_inner"]
    start, weight = model.vertices[ring], model.jaw_weight[ring]
    centre = start.mean(axis=0)
    # corner to corner and back: how far a point of the ring is from the corners, signed up
    upward = np.sin(np.pi * np.arange(20) / 10) ** 2 * np.where(np.arange(20) < 10, -1.0, 1.0)
    rings = []
    for back, across, tall in _LINING:
        point = start * [1.0, across, 1.0]
        # lips curve back at the corners, the throat does not
        point[:, 0] = np.interp(back, [0.0, 0.02], [1.0, 0.0]) * (start[:, 0] - centre[0])
        point[:, 0] += centre[0] - back
        point[:, 2] = centre[2] + (point[:, 2] - centre[2]) * across + tall * upward
        rings.append(point)
    share = np.array([1.0, 1.0, 1.0, 0.9, 0.7, 0.5])[:, None]
    middle = 0.5 * (1 - share)
    return loft(np.array(rings), weight * share + middle)


def teeth(centre: Floats, height: float, width: float = 0.021, depth: float = 0.026) -> Surface:
    """A dental arch, a curved band of the given height (signed: its edge is the lower if < 0)."""
    angle = np.linspace(-1.25, 1.25, 13)
    arch = centre + np.stack([depth * (np.cos(angle) - 1), width * np.sin(angle), 0 * angle], -1)
    edge = arch + np.array([0.001, 0.0, height])
    inner = edge - np.array([0.004, 0.0, 0.0])
    rings = np.stack([arch, edge, inner])
    if height < 0:
        rings = rings[:, ::-1]
    return loft(rings, np.zeros(rings.shape[:2]), closed=False)


def neck(head: Floats, torso: Floats) -> Surface:
    """A tube between the head and the bust, weight 1 at the bust. Points are in the head's frame.

    Args:
        head: (3,) centre of the upper end.
        torso: (3,) centre of the lower end.
    """
    steps = np.linspace(0.0, 1.0, 7)
    angle = np.linspace(0.0, 2 * np.pi, 20, endpoint=False)
    centre = head + (torso - head) * steps[:, None]
    radius = np.interp(steps, [0, 0.35, 0.7, 1.0], [0.045, 0.052, 0.058, 0.078])
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rings = centre[:, None] + radius[:, None, None] * circle
    weight = np.repeat((steps**2 * (3 - 2 * steps))[:, None], 20, axis=1)
    return loft(rings[:, ::-1], weight)


def bust() -> Surface:
    """Shoulders and chest in a shirt, relative to the mouth at rest; down to below the table."""
    #        height   half depth, half width, centre x, roundness
    profile = np.array(
        [
            [-0.128, 0.064, 0.066, -0.125, 2.0],
            [-0.140, 0.074, 0.082, -0.125, 2.0],
            [-0.152, 0.082, 0.120, -0.128, 2.1],
            [-0.165, 0.088, 0.165, -0.130, 2.2],
            [-0.185, 0.094, 0.198, -0.132, 2.4],
            [-0.215, 0.099, 0.215, -0.134, 2.5],
            [-0.260, 0.102, 0.219, -0.136, 2.6],
            [-0.330, 0.103, 0.212, -0.136, 2.6],
            [-0.480, 0.100, 0.200, -0.136, 2.6],
        ]
    )
    angle = np.linspace(0.0, 2 * np.pi, 32, endpoint=False)
    height, depth, width, x, power = (column[:, None] for column in profile.T)
    cosine, sine = np.cos(angle), np.sin(angle)
    rings = np.stack(
        [
            x + depth * np.sign(cosine) * np.abs(cosine) ** (2 / power),
            width * np.sign(sine) * np.abs(sine) ** (2 / power),
            np.repeat(height, 32, axis=1),
        ],
        axis=-1,
    )
    return loft(rings[:, ::-1], np.zeros(rings.shape[:2]))
