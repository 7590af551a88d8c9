"""Tasks that begin with the lift of an object: its pose in episodes, and times."""

from __future__ import annotations

from dataclasses import dataclass

from robo_manip_baselines.envs.mujoco.tasks.registry import Attribute, Field, ResultColumn

TIME_SINCE_LIFT = ResultColumn(
    "time_since_lift",
    "float",
    "s from the lift to the end of the episode; null without a lift",
    is_optional=True,
)
"""Column of result rows."""


def pose_field(description: str) -> Field:
    """Return the field ``object_pose`` of episodes."""
    return Field("object_pose", ("T", 7), description, "m, 1", "world", rule="unit quaternion")


def start_attribute(item: str) -> Attribute:
    """Return the attribute ``object_initial_pose`` of episodes."""
    description = f"Start pose of the {item}, as `object_pose`"
    return Attribute("object_initial_pose", "vector", description, length=7)


@dataclass(frozen=True)
class LiftProgress:
    """Times of an episode so far, in which an object is lifted and brought somewhere.

    Attributes:
        lift_time: s at which the object was lifted.
        success_time: s at which the task was done.
    """

    lift_time: float | None = None
    success_time: float | None = None

    @property
    def is_success(self) -> bool:
        """The task has been done."""
        return self.success_time is not None

    @property
    def completion_time(self) -> float | None:
        """s from the lift to the success; None before (paper, Table V)."""
        if self.success_time is None or self.lift_time is None:
            return None
        return self.success_time - self.lift_time

    def time_since_lift(self, time: float) -> float | None:
        """s since the lift; None before."""
        return None if self.lift_time is None else time - self.lift_time
