"""Geometry of a mouth: places in the face's axes, and the opening between the lips."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LIP_DEPTH = 0.01
"""m by which the lips stand out before the mouth's centre, the mean of all lip landmarks."""

CAVITY_DEPTH = 0.05
"""m behind the lips that is still in the mouth; further in is the throat."""


def from_mouth(
    point: NDArray[np.float64], mouth: NDArray[np.float64], mouth_axes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (3,) m, a point from the mouth in the face's axes: out, across, up.

    Args:
        point: (3,) m, world frame.
        mouth: (3,) m, centre of the opening, world frame.
        mouth_axes: (3, 3) columns: face normal pointing out, across (to the person's left), up;
            world frame.
    """
    return (point - mouth) @ mouth_axes


def is_inside_mouth(offset: NDArray[np.float64], half_width: float, half_height: float) -> bool:
    """Return whether a point is in the mouth opening, past the front of the lips.

    Args:
        offset: (3,) m, the point from the mouth, see ``from_mouth``.
        half_width: m, of the ellipse that the inner lips span.
        half_height: m, likewise.
    """
    out, across, up = offset.tolist()  # Python's floats are faster one by one
    if not -CAVITY_DEPTH <= out <= LIP_DEPTH:
        return False
    return bool((across / half_width) ** 2 + (up / half_height) ** 2 <= 1.0)
