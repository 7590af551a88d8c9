"""Metrics of a feeding episode from its ``info``, and the kind of failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.face_force import FaceForce, seconds
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import (
    MOUTH_TOLERANCE,
    Phase,
    is_at_mouth,
)

Offset = tuple[float, float, float]

CARRYING = {Phase.CARRY.name.lower(), Phase.DELIVER.name.lower()}
"""Phases from the lift of the cube until it is let go."""

RELEASED = Phase.RELEASE.name.lower()

REACH = 0.06
"""m along world x from the mouth, within which a gripper has come to the face: twice the tolerance
of Algorithm 1, line 10, so that letting go a little early does not hide that the aim was beside."""


class FeedingMetrics:
    """Closest approach, contact force and dwell of one episode; see `EpisodeMetrics`."""

    def __init__(self) -> None:
        self._force = FaceForce()
        self._steps_inside = 0
        self._distance: float | None = None
        self._offset: Offset | None = None
        self._nearness = np.inf
        self._cube_offset: Offset | None = None
        self._cube_distance = np.inf

    def update(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        self._force.update(float(info["face_force"]))
        if info["phase"] not in CARRYING:
            return
        gripper, mouth = np.asarray(info["utensil_position"]), np.asarray(info["mouth_position"])
        self._steps_inside += is_at_mouth(gripper, mouth)
        offset = gripper - mouth
        distance = float(np.linalg.norm(offset))
        self._distance = distance if self._distance is None else min(distance, self._distance)
        nearness = float(np.linalg.norm(offset / MOUTH_TOLERANCE))
        if nearness < self._nearness:
            self._nearness, self._offset = nearness, _offset(offset)
        cube_distance = float(np.linalg.norm(info["cube_offset"]))
        if cube_distance < self._cube_distance:
            self._cube_distance, self._cube_offset = cube_distance, _offset(info["cube_offset"])

    def result(self, info: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the kind of failure and the columns of the result row."""
        time, was_released = info["time_since_lift"], info["phase"] == RELEASED
        return failure_kind(bool(info["is_success"]), was_released, self._offset), {
            # Times are sums of 0.02 s; microseconds hide what floating point adds to them.
            "time_since_lift": None if time is None else round(float(time), 6),
            "closest_distance": self._distance,
            "closest_offset": self._offset,
            "cube_offset": self._cube_offset,
            **self._force.columns(),
            "dwell": seconds(self._steps_inside),
        }


def failure_kind(is_success: bool, was_released: bool, closest_offset: Offset | None) -> str:
    """Return the kind of failure of an episode; ``""`` for a success.

    The closest approach counts. A gripper that has come to the face and is beside the mouth
    has missed it, to the side where it is farthest; letting go there is part of the miss.

    Args:
        is_success: as in ``info``.
        was_released: the lifted cube was let go of, or lost, before the episode ended.
        closest_offset: (x, y, z) m, world, gripper minus mouth, at the closest approach with the
            cube; None if it was never lifted.
    """
    if is_success:
        return ""
    if closest_offset is None:
        return "never_grasped"
    is_within = np.abs(closest_offset) < MOUTH_TOLERANCE
    out, across, up = closest_offset
    if is_within[1:].all() or abs(out) >= REACH:
        return "dropped" if was_released or is_within.all() else "too_late"
    if abs(up) >= abs(across):
        return "missed_high" if up > 0.0 else "missed_low"
    return "missed_left" if across > 0.0 else "missed_right"


def _offset(vector: Any) -> Offset:
    x, y, z = np.asarray(vector).tolist()
    return x, y, z
