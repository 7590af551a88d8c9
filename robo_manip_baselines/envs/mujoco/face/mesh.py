"""Surfaces around the measured face: the rest of the head, hair, neck, bust, mouth and teeth.

Each function returns a `Surface` in the frame of the body it hangs on. They are plain lofts: rings
of points joined by strips of triangles. Legend: R rings, N points a ring. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

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
    halves = [(first, second, up_second), (first, up_second, up_first)]
    return np.concatenate([np.stack(half, 1) for half in halves]).astype(np.int32)


def loft(rings: Floats, weight: Floats, closed: bool = True) -> Surface:
    """Join rings (R, N, 3) of vertices with weights (R, N)."""
    count, points = rings.shape[:2]
    return Surface(rings.reshape(-1, 3), strips(count, points, closed), weight.reshape(-1))


def face_oval(model: FaceModel) -> NDArray[np.int64]:
    """The outline of the measured face as an ordered ring, counter-clockwise from the front."""
    triangles = model.triangles.tolist()
    edges = {edge: None for a, b, c in triangles for edge in ((a, b), (b, c), (c, a))}
    border = {a: b for a, b in edges if (b, a) not in edges}
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
    out, aside = np.cos(latitude), np.sin(latitude)
    direction = np.stack([out, aside * np.sin(around), aside * np.cos(around)], axis=-1)
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
    angles = np.deg2rad([0, 45, 80, 105, 140, 180])
    hairline = np.interp(around, angles, [0, 0, 0.1, 0.42, 0.62, 0.66])
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
    out = x + depth * np.sign(cosine) * np.abs(cosine) ** (2 / power)
    across = width * np.sign(sine) * np.abs(sine) ** (2 / power)
    rings = np.stack([out, across, np.repeat(height, 32, axis=1)], axis=-1)
    return loft(rings[:, ::-1], np.zeros(rings.shape[:2]))


WIDTH, HEIGHT = 512, 256
"""Pixels: about 1.2 mm each on the face, as fine as a 640x480 image from half a metre."""

AXIS_X = -0.05
"""The cylinder's axis, body frame, metres."""
BOTTOM, TOP = -0.17, 0.15
"""Heights of the texture's lower and upper edge, body frame, metres."""
WALL_RADIUS = 0.1
"""Radius at which azimuth is turned into metres: that of the cheeks."""

SKIN = (226, 178, 150)
BLUSH = (214, 134, 116)
LIP = (186, 82, 84)
LIP_LINE = (120, 40, 44)
SHADE = (150, 98, 78)
HAIR = (62, 40, 26)
DARK = (60, 30, 26)

# MediaPipe face mesh indices of what is painted beyond the rings of the surface file.
_CHEEKS = (50, 280)
_NOSTRILS = (((98, 240, 99), (64, 240)), ((327, 460, 328), (294, 460)))
_UPPER_LASHES = (
    (33, 246, 161, 160, 159, 158, 157, 173, 133),
    (263, 466, 388, 387, 386, 385, 384, 398, 362),
)
_LOWER_LASHES = (
    (33, 7, 163, 144, 145, 153, 154, 155, 133),
    (263, 249, 390, 373, 374, 380, 381, 382, 362),
)
_CREASES = ((247, 30, 29, 27, 28, 56), (467, 260, 259, 257, 258, 286))
_BROWS = (
    (70, 63, 105, 66, 107, 55, 65, 52, 53, 46),
    (300, 293, 334, 296, 336, 285, 295, 282, 283, 276),
)
_LIP_CORNERS = (61, 291)


def texture_coordinates(points: Floats) -> Floats:
    """Texture coordinates (..., 2), 0..1, of points (..., 3) in the body frame."""
    azimuth = np.arctan2(points[..., 1], points[..., 0] - AXIS_X)
    height = (points[..., 2] - BOTTOM) / (TOP - BOTTOM)
    return np.stack([0.5 + azimuth / (2 * np.pi), 1 - np.clip(height, 0.0, 1.0)], axis=-1)


class _Canvas:
    """An image on the wall; every stroke blends a colour in with a soft mask."""

    def __init__(self) -> None:
        self.image = np.full((HEIGHT, WIDTH, 3), SKIN, float)
        azimuth = ((np.arange(WIDTH) + 0.5) / WIDTH - 0.5) * 2 * np.pi
        height = TOP - (np.arange(HEIGHT) + 0.5) / HEIGHT * (TOP - BOTTOM)
        self.grid = np.stack(np.meshgrid(azimuth * WALL_RADIUS, height), axis=-1)

    def blend(self, colour: Sequence[float], mask: Floats) -> None:
        self.image += (np.asarray(colour) - self.image) * mask[..., None]

    def spot(
        self, colour: Sequence[float], centre: Floats, size: Sequence[float], alpha: float
    ) -> None:
        """A Gaussian spot; ``size`` is its standard deviation across and up, metres."""
        away = (self.grid - centre) / np.asarray(size)
        self.blend(colour, alpha * np.exp(-0.5 * (away**2).sum(axis=-1)))

    def stroke(self, colour: Sequence[float], line: Floats, width: float, alpha: float) -> None:
        """A line of the given half width with an edge of a millimetre and a half."""
        distance = _distance(self.grid, line)
        self.blend(colour, alpha * np.clip(1 - (distance - width) / 0.0015, 0.0, 1.0))

    def patch(self, colour: Sequence[float], ring: Floats, edge: float, alpha: float) -> None:
        """A filled polygon whose edge is ``edge`` metres soft."""
        closed = np.concatenate([ring, ring[:1]])
        signed = np.where(_inside(self.grid, ring), -1.0, 1.0) * _distance(self.grid, closed)
        self.blend(colour, alpha * np.clip(0.5 - signed / edge, 0.0, 1.0))


def _distance(grid: Floats, line: Floats) -> Floats:
    """Distance of every grid point to a polyline (n, 2); infinite beyond 2 cm of its box."""
    result = np.full(grid.shape[:2], np.inf)
    near = ((grid > line.min(axis=0) - 0.02) & (grid < line.max(axis=0) + 0.02)).all(axis=-1)
    points = grid[near][:, None]
    start, step = line[:-1], np.diff(line, axis=0)
    along = ((points - start) * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-12)
    nearest = start + np.clip(along, 0.0, 1.0)[..., None] * step
    result[near] = np.linalg.norm(points - nearest, axis=-1).min(axis=-1)
    return result


def _inside(grid: Floats, ring: Floats) -> NDArray[np.bool_]:
    """Return whether grid points lie in a polygon (even-odd rule)."""
    x, y = grid[..., 0], grid[..., 1]
    odd = np.zeros(x.shape, dtype=bool)
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if y0 != y1:
            odd ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return odd


@lru_cache(maxsize=1)
def paint() -> NDArray[np.uint8]:
    """The texture, (`HEIGHT`, `WIDTH`, 3) uint8 RGB, top row first."""
    model = FaceModel.load()
    x, y, z = model.vertices.T
    at = np.stack([np.arctan2(y, x - AXIS_X) * WALL_RADIUS, z], axis=-1)  # (V, 2) m, on the wall
    canvas = _Canvas()
    for cheek in _CHEEKS:
        canvas.spot(BLUSH, at[cheek] + [0.0, -0.006], (0.017, 0.014), 0.5)
    canvas.spot(BLUSH, at[4], (0.010, 0.008), 0.35)
    canvas.spot(SHADE, at[2] - [0.0, 0.002], (0.010, 0.003), 0.35)
    canvas.spot(SHADE, at[17] - [0.0, 0.008], (0.014, 0.003), 0.30)
    for side in (0, 1):
        lid, crease = list(_UPPER_LASHES[side]), list(_CREASES[side])
        lower = list(_LOWER_LASHES[side])
        canvas.spot(SHADE, at[crease].mean(axis=0), (0.016, 0.006), 0.25)
        canvas.spot(SHADE, at[lower].mean(axis=0) - [0, 0.004], (0.012, 0.004), 0.2)
        canvas.stroke(SHADE, at[crease], 0.0003, 0.55)
        canvas.stroke(DARK, at[lid], 0.0010, 0.95)
        canvas.stroke(SHADE, at[lower], 0.0002, 0.6)
        canvas.patch(HAIR, at[list(_BROWS[side])], 0.004, 0.9)
        for nostril in _NOSTRILS[side]:
            canvas.spot(DARK, at[list(nostril)].mean(axis=0), (0.0022, 0.0016), 0.55)
    outer, inner = at[model.rings["lips_outer"]], at[model.rings["lips_inner"]]
    canvas.patch(LIP, outer, 0.003, 1.0)
    canvas.stroke(LIP_LINE, np.concatenate([inner, inner[:1]]), 0.0004, 0.5)
    for corner in _LIP_CORNERS:
        canvas.spot(LIP_LINE, at[corner], (0.002, 0.002), 0.5)
    return np.clip(canvas.image + 0.5, 0, 255).astype(np.uint8)
