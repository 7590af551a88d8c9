"""Success of bimanual feeding: the hand-over that precedes what `feeding.success` describes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Hands:
    """Hands on the cube in one control step.

    Attributes:
        right_holds: both fingers of the right gripper touch the cube.
        left_holds: likewise of the left one.
        right_touches: any finger of the right gripper touches it.
        left_touches: likewise of the left one.
    """

    right_holds: bool = False
    left_holds: bool = False
    right_touches: bool = False
    left_touches: bool = False


@dataclass(frozen=True)
class Handover:
    """Hand-over of the lifted cube from the left gripper to the right, in the air.

    Attributes:
        time: s since the start of the episode at which it was over: the first moment at which the
            right gripper alone held the cube, which had been lifted and not been let go of.
    """

    time: float | None = None

    def advance(self, time: float, hands: Hands, *, is_carried: bool) -> Handover:
        """Take in one control step.

        Args:
            time: s since the start of the episode.
            hands: on the cube.
            is_carried: the cube was lifted before this step, and has not been let go of since.
        """
        if self.time is None and is_carried and hands.right_holds and not hands.left_touches:
            return Handover(time)
        return self
