"""Times of contact forces that tasks with a face count in their episodes.

Importing this module imports no simulator: the entries of tasks use it.
"""

from __future__ import annotations

from robo_manip_baselines.envs.mujoco.tasks.registry import ResultColumn

FORCE_LIMITS = (1, 10, 30)
"""N, forces on the face above which time is counted, those of `FeedingEnv`: a touch, a push, and
one that hurts."""

FORCE_COLUMNS = (
    ResultColumn(
        "face_force",
        "float",
        "N, largest normal force between robot and face",
        in_report=True,
        unit="N",
        in_tables=True,
    ),
    *(
        ResultColumn(
            f"force_time_{limit}",
            "float",
            f"s, time with more than {limit} N between robot and face",
            unit="s",
            in_tables=True,
        )
        for limit in FORCE_LIMITS
    ),
)
"""Columns of `ForceTimes`."""


class ForceTimes:
    """Largest force on the face in an episode, and the time above each of `FORCE_LIMITS`."""

    def __init__(self) -> None:
        self._largest = 0.0
        self._steps_above = dict.fromkeys(FORCE_LIMITS, 0)

    def update(self, force: float) -> None:
        """Take in the largest force of a control step, N."""
        self._largest = max(self._largest, force)
        for limit in FORCE_LIMITS:
            self._steps_above[limit] += force > limit

    def columns(self, period: float) -> dict[str, float]:
        """Return the values of `FORCE_COLUMNS`, given the control period in s."""
        return {
            "face_force": self._largest,
            # Microseconds hide what floating point adds to sums of control periods.
            **{f"force_time_{f}": round(n * period, 6) for f, n in self._steps_above.items()},
        }
