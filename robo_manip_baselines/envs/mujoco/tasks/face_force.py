"""Metrics of the force on the face in an episode, for every task that records ``face_force``."""

from __future__ import annotations

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.registry import FORCE_LIMITS


class FaceForce:
    """Largest force on the face, and the time above each of ``FORCE_LIMITS``.

    Attributes:
        largest: N, so far.
    """

    def __init__(self) -> None:
        self.largest = 0.0
        self._steps_above = dict.fromkeys(FORCE_LIMITS, 0)

    def update(self, force: float) -> None:
        """Take in the largest force of a control step, N."""
        self.largest = max(self.largest, force)
        for limit in FORCE_LIMITS:
            self._steps_above[limit] += force > limit

    def columns(self) -> dict[str, float]:
        """Return the values of ``FORCE_COLUMNS``."""
        times = {f"force_time_{f}": seconds(steps) for f, steps in self._steps_above.items()}
        return {"face_force": self.largest, **times}


def seconds(steps: int) -> float:
    """Return the time of control steps, without what floating point adds to it."""
    return round(steps * CONTROL_PERIOD, 6)
