"""Metrics of a wiping episode from its ``info``, and the kind of failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robo_manip_baselines.envs.mujoco.tasks.face_force import FaceForce, seconds
from robo_manip_baselines.envs.mujoco.tasks.wiping.success import FORCE_HIGH, FORCE_LOW


class WipingMetrics:
    """Wiped share and contact force of one episode; see `EpisodeMetrics`."""

    def __init__(self) -> None:
        self._face_force = FaceForce()
        self._below = self._within = self._above = 0
        self._sum = 0.0

    def update(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        self._face_force.update(float(info["face_force"]))
        force = float(info["pad_force"])
        self._sum += force
        self._below += 0.0 < force < FORCE_LOW
        self._within += FORCE_LOW <= force <= FORCE_HIGH
        self._above += force > FORCE_HIGH

    def result(self, info: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the kind of failure and the columns of the result row."""
        steps = self._below + self._within + self._above
        kind = failure_kind(bool(info["is_success"]), self._below, self._within, self._above)
        return kind, {
            "wiped_share": float(info["wiped_share"]),
            "pad_force_mean": self._sum / steps if steps else None,
            "contact_time": seconds(steps),
            "range_share": self._within / steps if steps else None,
            **self._face_force.columns(),
        }


def failure_kind(is_success: bool, below: int, within: int, above: int) -> str:
    """Return the kind of failure of an episode; ``""`` for a success.

    Args:
        is_success: as in ``info``.
        below: control steps in contact with less force than the pad wipes with.
        within: those with a force in the range.
        above: those with more.
    """
    if is_success:
        return ""
    if below + within + above == 0:
        return "no_contact"
    if within >= below + above:
        return "missed"
    return "too_hard" if above > below else "too_light"
