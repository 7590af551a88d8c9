"""Success of bimanual feeding: the hand-over that precedes what `feeding.success` describes."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Hands:
    """Fingers of each gripper, 0 to 2, that touched the cube in one control step."""

    left: int = 0
    right: int = 0

    @property
    def is_held(self) -> bool:
        """Both fingers of a gripper touched it."""
        return 2 in (self.left, self.right)


@dataclass(frozen=True)
class Handover:
    """Hand-over of the lifted cube from the left gripper to the right, in the air.

    Attributes:
        was_left: the left gripper has held the lifted cube, which has not been let go of since.
        time: s since the start of the episode at which the hand-over was over: the right gripper
            held the cube and the left one touched it no more.
    """

    was_left: bool = False
    time: float | None = None

    def advance(self, time: float, hands: Hands, *, is_carried: bool) -> Handover:
        """Take in one control step.

        Args:
            time: s since the start of the episode.
            hands: on the cube.
            is_carried: the cube was lifted before this step, and has not been let go of since.
        """
        was_left = is_carried and (self.was_left or hands.left == 2)
        is_over = was_left and hands.right == 2 and not hands.left
        return replace(
            self, was_left=was_left, time=time if self.time is None and is_over else self.time
        )
