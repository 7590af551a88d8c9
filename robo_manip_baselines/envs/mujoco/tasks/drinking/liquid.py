"""Liquid in a cup with a spout: its level, what flows out, and where that goes.

The liquid is a volume at rest: its surface is level however the cup is turned, and a closed lid
leaves it one way out, the opening of the spout. A vent in the lid lets air in. Frame of the cup:
origin in the middle of the body, x towards the spout, z up along the axis; metres and m³.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CAVITY_RADIUS = 0.023
CAVITY_HEIGHT = 0.051
"""m, the inside of the body, an upright cylinder about the origin of its frame."""

SPOUT_TIP = np.array([0.072, 0.0, 0.0225])
"""m, centre of the spout's opening: so far out that the nose has room beside the tilted body, and
above the level of a serving by so much that it takes a tilt of 19 degrees to pour."""

SPOUT_ROOT = np.array([0.021, 0.0, -0.0165])
"""m, where the spout leaves the body, near its foot."""

SPOUT_AXIS = (SPOUT_TIP - SPOUT_ROOT) / np.linalg.norm(SPOUT_TIP - SPOUT_ROOT)
"""Unit vector along the spout, out of it."""

SERVING = 40e-6
"""m³ of liquid at the start: two swallows of an adult, 21 ml each on average (Adnerhill et al.
1989)."""

OPENING_AREA = np.pi * 0.004**2
"""m² of the spout's opening, 8 mm wide: the wider of the common ones, for drinks, not for food."""

DISCHARGE = 0.62
"""Flow through a sharp-edged opening as a share of Torricelli's, for water."""

GRAVITY = 9.81
"""m/s²."""


def _parcels(count: int) -> Floats:
    """Return (N, 3) m, centres of equal parts of the cavity.

    Heights are equally spaced; area and angle follow the additive recurrence of Roberts (2018),
    which leaves neither gaps nor rows that a level surface would meet all at once.
    """
    number = np.arange(count)
    plastic = 1.324717957244746  # the root of x³ = x + 1
    radius = CAVITY_RADIUS * np.sqrt((0.5 + number / plastic) % 1.0)
    angle = 2.0 * np.pi * (0.5 + number / plastic**2)
    z = CAVITY_HEIGHT * ((number + 0.5) / count - 0.5)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


PARCELS = _parcels(2000)

CAPACITY = np.pi * CAVITY_RADIUS**2 * CAVITY_HEIGHT
"""m³."""


def surface_height(volume: float, up: Floats) -> float:
    """Return m, the height of the liquid's surface along ``up`` from the origin of the cup.

    That is the height below which the cavity holds the volume, found among 2000 equal parts of it
    (to 1.5 % of a serving); -inf for no liquid.

    Args:
        volume: m³, 0 to `CAPACITY`.
        up: (3,) unit vector against gravity, in the frame of the cup.
    """
    if volume <= 0.0:
        return -np.inf
    heights = PARCELS @ up
    place = min(max(volume / CAPACITY * len(heights) - 0.5, 0.0), len(heights) - 1.0)
    low = int(place)
    high = min(low + 1, len(heights) - 1)
    sorted_here = np.partition(heights, (low, high))
    below, above = sorted_here[low], sorted_here[high]
    return float(below + (place - low) * (above - below))


def outflow_speed(surface: float, up: Floats) -> float:
    """Return m/s, Torricelli's speed at the spout's opening; 0 if that is above the surface.

    Args:
        surface: m, see `surface_height`.
        up: (3,) unit vector against gravity, in the frame of the cup.
    """
    head = max(surface - float(SPOUT_TIP @ up), 0.0)
    return math.sqrt(2.0 * GRAVITY * head)


def jet_at(time: float | Floats, start: Floats, velocity: Floats) -> Floats:
    """Return (..., 3) m, where liquid is ``time`` (...) s after it left the spout, world frame."""
    flight = np.asarray(time)[..., None]
    return start + flight * velocity - 0.5 * GRAVITY * flight**2 * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Liquid:
    """Volumes of the serving: in the cup, in the mouth, or anywhere else.

    Attributes:
        left, delivered, spilled: m³; their sum is always `SERVING`.
    """

    left: float = SERVING
    delivered: float = 0.0
    spilled: float = 0.0

    def flow(self, speed: float, duration: float, is_into_mouth: bool) -> Liquid:
        """Let liquid flow out of the spout.

        Args:
            speed: m/s, see `outflow_speed`.
            duration: s.
            is_into_mouth: whether it is delivered, else it is spilled.
        """
        out = min(self.left, DISCHARGE * OPENING_AREA * speed * duration)
        left = self.left - out
        if is_into_mouth:
            return replace(self, left=left, delivered=self.delivered + out)
        return replace(self, left=left, spilled=self.spilled + out)

    @property
    def delivered_share(self) -> float:
        """Part of the serving that is in the mouth, 0 to 1."""
        return self.delivered / SERVING

    @property
    def spilled_share(self) -> float:
        """Part of the serving that was spilled, 0 to 1."""
        return self.spilled / SERVING
