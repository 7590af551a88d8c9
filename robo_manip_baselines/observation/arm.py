"""Kinematics of the VX300s in closed form, without a simulator.

The gripper's position and the three joints of the wrist say where an arm is as its six joints do:
while the wrist stays, waist, shoulder and elbow follow from the position. So a target of the joints
can be written with the gripper's position in it, and read back to rounding.

Legend: ... any leading shape; joints in the order of `ARM_JOINTS`, rad; positions in the world, m.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

ARM_JOINTS: Final = (
    "waist",
    "shoulder",
    "elbow",
    "forearm_roll",
    "wrist_angle",
    "wrist_rotate",
)
"""Joints of an arm, base to gripper, in the order of state and action."""

BASES: Final = {"left": (-0.469, 0.5, 1.0), "right": (0.469, 0.5, -1.0)}
"""x and y of each arm's base, m, and the direction in which it faces along x."""

_SHOULDER = 0.079 + 0.04805
_ELBOW = (0.05955, 0.3)
_WRIST = 0.2 + 0.1
_GRIPPER = 0.069744 + 0.1072
"""m: height of the shoulder, elbow forward of and above it, wrist from the elbow, and site
``gripper`` from the wrist; those of ``assets/vx300s.xml``, with which a test compares them."""


def gripper_position(arm: str, joints: ArrayLike) -> Floats:
    """Return the position (..., 3) of an arm's site ``gripper`` at joints (..., 6)."""
    waist, shoulder, elbow, *wrist = np.moveaxis(np.asarray(joints, np.float64), -1, 0)
    x, y, z = _in_forearm(*wrist[:2])
    x, z = _turned(x, z, elbow)
    x, z = _turned(x + _ELBOW[0], z + _ELBOW[1], shoulder)
    base_x, base_y, facing = BASES[arm]
    cos, sin = np.cos(waist), np.sin(waist)
    world = (base_x + facing * (cos * x - sin * y), base_y + facing * (sin * x + cos * y))
    return np.stack([*world, z + _SHOULDER], axis=-1)


def joints_at(arm: str, position: ArrayLike, wrist: ArrayLike) -> Floats:
    """Return the joints (..., 6) that have the gripper at a position (..., 3).

    ``wrist`` (..., 3) are the last three joints, which stay. The gripper is in front of the waist
    and the elbow above the line from shoulder to wrist. A position out of reach gives the joints
    that point to it with the arm as long, or as short, as it gets.
    """
    base_x, base_y, facing = BASES[arm]
    place = np.asarray(position, np.float64)
    x, y = facing * (place[..., 0] - base_x), facing * (place[..., 1] - base_y)
    z = place[..., 2] - _SHOULDER
    roll, angle, rotate = np.moveaxis(np.asarray(wrist, np.float64), -1, 0)
    out, aside, up = _in_forearm(roll, angle)
    ahead = np.sqrt(np.maximum(x**2 + y**2 - aside**2, 0.0))
    waist = np.arctan2(y, x) - np.arctan2(aside, ahead)
    # Two links in a plane: to the elbow, and from it to the gripper.
    upper, lower = np.hypot(*_ELBOW), np.hypot(out, up)
    bend = (ahead**2 + z**2 - upper**2 - lower**2) / (2.0 * upper * lower)
    between = -np.arccos(np.clip(bend, -1.0, 1.0))  # direction of the second less of the first
    first = np.arctan2(z, ahead) - np.arctan2(
        lower * np.sin(between), upper + lower * np.cos(between)
    )
    # A positive angle about y turns x towards -z.
    shoulder = np.arctan2(_ELBOW[1], _ELBOW[0]) - first
    elbow = np.arctan2(up, out) - np.arctan2(_ELBOW[1], _ELBOW[0]) - between
    waist, shoulder, elbow = (np.arctan2(np.sin(a), np.cos(a)) for a in (waist, shoulder, elbow))
    return np.stack([waist, shoulder, elbow, roll, angle, rotate], axis=-1)


def _in_forearm(roll: Floats, angle: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the gripper's x, y, z from the elbow, in the frame of the forearm before it rolls."""
    aside = _GRIPPER * np.sin(angle)
    return _WRIST + _GRIPPER * np.cos(angle), aside * np.sin(roll), -aside * np.cos(roll)


def _turned(x: Floats, z: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """Turn (x, z) by an angle about y."""
    cos, sin = np.cos(angle), np.sin(angle)
    return x * cos + z * sin, z * cos - x * sin
