"""BimanualFeedingEnv: fetch a cube with one hand, pass it to the other, bring it to the mouth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CUBE_SIZE
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.success import Handover, Hands
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import Phase, StepMeasurements

CUBE_LOW = np.array([-0.44, 0.17])
CUBE_HIGH = np.array([-0.34, 0.27])
"""m, world x and y between which the cube starts: beside the left arm's base. It is 0.84 m or more
from the right arm's shoulder, which reaches 0.80 m with its finger tips."""

LEFT_HOME_QPOS = (-1.3, *HOME_QPOS[1:])
"""rad, the left arm at home but turned away from the head, towards the cube."""


class BimanualFeedingEnv(FeedingEnv):
    """TODO"""

    task = ENTRY
    phase_names = ("reach", "grasp", "pass", "carry", "deliver", "release")

    def __init__(self, *, arms: str = "both", **kwargs: Any) -> None:
        super().__init__(arms=arms, **kwargs)

    def reset_task(self, rng: np.random.Generator) -> None:
        """Put the cube somewhere on the table beside the left arm, which is ready for it."""
        super().reset_task(rng)
        self.handover = Handover()
        self._set_arm("left", LEFT_HOME_QPOS, FINGER_OPEN)

    def draw_cube(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw where the cube starts, (2,) m, world x and y."""
        return rng.uniform(CUBE_LOW, CUBE_HIGH)

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        progress = self.progress
        is_carried = progress.lift_time is not None and progress.release_time is None
        self.handover = self.handover.advance(self.time, self._hands(), is_carried=is_carried)
        return super().advance()

    def info(self) -> dict[str, Any]:
        """Return what the class docstring lists under Info."""
        progress, time, info = self.progress, self.handover.time, super().info()
        if progress.phase is Phase.CARRY and time is None:
            info["phase"] = "pass"
        return {**info, "handover_time": None if time is None else progress.time_since_lift(time)}

    def _hands(self) -> Hands:
        left, right = self._fingers_on("left"), self._fingers_on("right")
        return Hands(right == 2, left == 2, right > 0, left > 0)

    def _measure(self) -> StepMeasurements:
        """Return the measurements of feeding, for which either hand may lift the cube."""
        step, hands = super()._measure(), self._hands()
        is_brought = hands.right_holds and self.handover.time is not None
        return replace(
            step,
            is_held=hands.right_holds or hands.left_holds,
            is_touched=hands.right_touches or hands.left_touches,
            is_at_mouth=step.is_at_mouth and is_brought,
        )
