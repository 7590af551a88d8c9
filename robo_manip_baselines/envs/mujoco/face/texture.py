"""Paint the head's texture: skin, lips, eyebrows, lashes and scalp, from the landmarks alone.

The texture is a cylinder's wall unrolled: columns are the azimuth about a vertical axis inside
the head (the face looks along azimuth 0, in the middle of the image), rows are height. Painting is
done in metres on that wall, so that a brow is as thick on the temple as at the nose.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face.model import FaceModel

Floats = NDArray[np.float64]

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


def _wall(points: Floats) -> Floats:
    """Metres (..., 2) on the unrolled wall of points (..., 3) in the body frame."""
    azimuth = np.arctan2(points[..., 1], points[..., 0] - AXIS_X)
    return np.stack([azimuth * WALL_RADIUS, points[..., 2]], axis=-1)


class _Canvas:
    """An image on the wall; every stroke blends a colour in with a soft mask."""

    def __init__(self) -> None:
        self.image = np.empty((HEIGHT, WIDTH, 3))
        self.image[:] = SKIN
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
    """Whether grid points lie in a polygon (even-odd rule)."""
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
    at = _wall(model.vertices)
    canvas = _Canvas()
    for cheek in _CHEEKS:
        canvas.spot(BLUSH, at[cheek] + [0.0, -0.006], (0.017, 0.014), 0.5)
    canvas.spot(BLUSH, at[4], (0.010, 0.008), 0.35)
    canvas.spot(SHADE, at[2] - [0.0, 0.002], (0.010, 0.003), 0.35)
    canvas.spot(SHADE, at[17] - [0.0, 0.008], (0.014, 0.003), 0.30)
    for side in (0, 1):
        lid, crease = list(_UPPER_LASHES[side]), list(_CREASES[side])
        canvas.spot(SHADE, at[crease].mean(axis=0), (0.016, 0.006), 0.25)
        canvas.spot(
            SHADE, at[list(_LOWER_LASHES[side])].mean(axis=0) - [0, 0.004], (0.012, 0.004), 0.2
        )
        canvas.stroke(SHADE, at[crease], 0.0003, 0.55)
        canvas.stroke(DARK, at[lid], 0.0010, 0.95)
        canvas.stroke(SHADE, at[list(_LOWER_LASHES[side])], 0.0002, 0.6)
        canvas.patch(HAIR, at[list(_BROWS[side])], 0.004, 0.9)
        for nostril in _NOSTRILS[side]:
            canvas.spot(DARK, at[list(nostril)].mean(axis=0), (0.0022, 0.0016), 0.55)
    outer, inner = at[model.rings["lips_outer"]], at[model.rings["lips_inner"]]
    canvas.patch(LIP, outer, 0.003, 1.0)
    canvas.stroke(LIP_LINE, np.concatenate([inner, inner[:1]]), 0.0004, 0.5)
    for corner in _LIP_CORNERS:
        canvas.spot(LIP_LINE, at[corner], (0.002, 0.002), 0.5)
    return np.clip(canvas.image + 0.5, 0, 255).astype(np.uint8)


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """A PNG file of an (H, W, 3) RGB image: what MuJoCo reads textures from."""
    height, width = image.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in image)

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows, 6)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
