"""Metrics of one evaluation episode, and the kind of failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

NEAR = 0.03
"""m between finger tips and chin within which a miss is a near one."""


class ChinTouchMetrics:
    """Closest approach and largest force of one episode; see `EpisodeMetrics`."""

    def __init__(self) -> None:
        self._distance, self._force = np.inf, 0.0

    def update(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        self._distance = min(self._distance, float(info["chin_distance"]))
        self._force = max(self._force, float(info["face_force"]))

    def result(self, info: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the kind of failure and the columns of the result row."""
        failure = "missed" if self._distance < NEAR else "too_far"
        return (
            "" if info["is_success"] else failure,
            {"chin_distance": self._distance, "face_force": self._force},
        )
