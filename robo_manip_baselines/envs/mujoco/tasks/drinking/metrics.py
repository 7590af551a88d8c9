"""Metrics of a drinking episode from its ``info``, and the kind of failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.drinking.success import DELIVERED_SHARE
from robo_manip_baselines.envs.mujoco.tasks.face_force import FaceForce, seconds


class DrinkingMetrics:
    """Liquid, closest approach, force and dwell of one episode; see `EpisodeMetrics`."""

    def __init__(self) -> None:
        self._force = FaceForce()
        self._steps_inside = 0
        self._distance: float | None = None
        self._was_dropped = False

    def update(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        self._force.update(float(info["face_force"]))
        self._steps_inside += bool(info["is_spout_inside"])
        if info["time_since_lift"] is None:
            return
        if not info["is_touched"]:
            self._was_dropped = self._was_dropped or not info["is_success"]
            return
        distance = float(np.linalg.norm(info["spout_position"] - info["mouth_position"]))
        self._distance = distance if self._distance is None else min(distance, self._distance)

    def result(self, info: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the kind of failure and the columns of the result row."""
        time, spilled = info["time_since_lift"], float(info["spilled"])
        failure = failure_kind(
            is_success=bool(info["is_success"]),
            was_lifted=time is not None,
            was_dropped=self._was_dropped,
            spilled=spilled,
            was_inside=self._steps_inside > 0,
        )
        return failure, {
            # Times are sums of 0.02 s; microseconds hide what floating point adds to them.
            "time_since_lift": None if time is None else round(float(time), 6),
            "delivered": float(info["delivered"]),
            "spilled": spilled,
            "closest_distance": self._distance,
            **self._force.columns(),
            "dwell": seconds(self._steps_inside),
        }


def failure_kind(
    *, is_success: bool, was_lifted: bool, was_dropped: bool, spilled: float, was_inside: bool
) -> str:
    """Return the kind of failure of an episode; ``""`` for a success.

    Args:
        is_success: as in ``info``.
        was_lifted: the cup was.
        was_dropped: no finger touched the lifted cup any more, before the success.
        spilled: share of the liquid.
        was_inside: the tip of the spout was in the mouth.
    """
    if is_success:
        return ""
    if not was_lifted:
        return "never_grasped"
    if was_dropped:
        return "dropped"
    if spilled > 1.0 - DELIVERED_SHARE:
        return "spilled"
    return "too_late" if was_inside else "missed"
