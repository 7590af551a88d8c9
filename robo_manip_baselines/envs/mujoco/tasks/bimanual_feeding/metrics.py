"""Metrics of a bimanual feeding episode from its ``info``, and the kind of failure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robo_manip_baselines.envs.mujoco.tasks.feeding.metrics import RELEASED, FeedingMetrics


class BimanualFeedingMetrics(FeedingMetrics):
    """Metrics of feeding, from the hand-over on, and the time of the hand-over."""

    def result(self, info: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the kind of failure and the columns of the result row."""
        failure, columns = super().result(info)
        handover_time = info["handover_time"]
        if handover_time is None and info["time_since_lift"] is not None:
            failure = "dropped" if info["phase"] == RELEASED else "not_handed_over"
        time = None if handover_time is None else round(float(handover_time), 6)
        return failure, {**columns, "handover_time": time}
